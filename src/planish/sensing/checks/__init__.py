"""What a capture says about itself: one module per question, answers as findings, what is unusable as InputError."""

"""What a capture says about itself: one module per question; answers are findings, what cannot be used is an InputError."""

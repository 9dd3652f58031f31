"""What real steel says beyond one registration."""

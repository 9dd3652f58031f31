"""What all benchmarks share: cells of long statistics, captures from memory, timing."""

"""Everything that exists for a compiler: many worlds in one kernel, and numbers that are stored, not repeated."""

"""Everything that exists for a compiler: many worlds at once, and what XLA should keep."""

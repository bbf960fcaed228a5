"""Program transformations for speed: many worlds in one kernel, stored intermediate results, conditional work."""

"""The environments as other libraries want them, one file per library, each imported only when asked for."""

"""Environments with the interfaces of other libraries, one file per library, imported only when asked for."""

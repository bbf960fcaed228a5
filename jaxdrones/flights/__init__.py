"""The demonstrations of the command line: what is flown, under which conditions, and the record of it."""

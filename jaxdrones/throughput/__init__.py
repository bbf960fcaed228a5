"""How many steps per second this machine makes, and what a number needs beside it: versions, machine, method."""

"""Who integrates the wrenches: `explicit` (JAX). Each backend has a `make_step` of the same meaning."""

"""`make demo`: the whole way in a few minutes, on a small set of tasks."""

"""`make demo`: the whole way in a quarter of an hour, on a small set of tasks."""

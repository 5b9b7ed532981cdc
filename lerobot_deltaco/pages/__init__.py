"""Pages that show datasets, policies and episodes."""

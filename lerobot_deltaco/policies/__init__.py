"""Policies: what each shares with the others in `base`, and one folder for each `--policy.type`."""

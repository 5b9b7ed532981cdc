"""The parts of the policy: networks, losses, and where instructions and demonstrations come from."""

"""The parts of the policy: networks, losses, and the sources of instructions and demonstrations."""

"""What the policies share: configuration, episodes, networks, losses and checkpoints."""

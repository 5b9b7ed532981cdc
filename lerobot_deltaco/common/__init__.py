"""What several rooms share, without LeRobot and torch."""

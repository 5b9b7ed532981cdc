"""A page to play with a trained policy. Importing it, and all of it but `episodes`, is quick: no LeRobot."""

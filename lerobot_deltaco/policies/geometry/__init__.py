"""Robot states, image locations and trajectories: geometry that is learned from episodes, for any objects."""

"""Goals: where to grasp and release, found in a scene by a demonstration or an instruction (ours)."""

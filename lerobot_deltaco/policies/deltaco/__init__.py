"""`--policy.type=deltaco`: the method, baselines and ablations of the paper."""

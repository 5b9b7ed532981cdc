"""LeRobot's pipelines around the policy."""

from lerobot_deltaco.policies.deltaco.processor_deltaco import make_deltaco_pre_post_processors

# LeRobot looks for the function of this name.
make_deltaco_match_pre_post_processors = make_deltaco_pre_post_processors

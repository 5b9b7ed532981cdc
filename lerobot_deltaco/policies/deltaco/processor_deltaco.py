"""LeRobot's pipelines around the policy."""

from lerobot_deltaco.policies.base.processor import make_task_conditioned_pre_post_processors

# LeRobot looks for the function of this name.
make_deltaco_pre_post_processors = make_task_conditioned_pre_post_processors

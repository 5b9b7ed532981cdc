"""LeRobot's policy server, for policies of this project: inference on another computer than the robot's.

    pip install 'lerobot[async]'
    python examples/policy_server.py --host=0.0.0.0 --port=8080

LeRobot 0.6.1 serves a fixed list of policies, and loads no plugins. The checkpoint has to contain the
demonstrations: the server passes no options to a policy. Each connection of a client is one episode.
"""

from lerobot.async_inference import constants, policy_server

import lerobot_policy_deltaco  # noqa: F401  (registers the types of this project)

constants.SUPPORTED_POLICIES += ["deltaco", "deltaco_match"]

if __name__ == "__main__":
    policy_server.serve()

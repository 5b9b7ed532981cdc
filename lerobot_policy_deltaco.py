"""What LeRobot imports: it looks for a distribution, and in it a module, of this very name."""

import atexit
import sys

try:
    # These register `--env.type=deltaco`, and both policies with the steps of their processors.
    import lerobot_deltaco.evaluation.lerobot_env
    import lerobot_deltaco.policies.deltaco.configuration_deltaco
    import lerobot_deltaco.policies.deltaco_match.configuration_deltaco_match  # noqa: F401
except Exception as error:
    problem = (
        "lerobot_policy_deltaco could not be imported, so LeRobot does not know its types "
        f"({type(error).__name__}: {error}). Install the project again, as its README says."
    )
    # LeRobot only logs the error, before hundreds of lines of usage. Let it also be the last thing to read.
    atexit.register(lambda: sys.stderr.write(f"\n{problem}\n"))
    raise ImportError(problem) from error

"""`deltaco-train`: `lerobot-train` with the frames in memory, and the paper's batches."""

import sys

from draccus.utils import ParsingError

from lerobot_deltaco.lerobot_internals import UnsupportedLeRobotError, reason_of
from lerobot_deltaco.policy.finite_loss import TrainingDivergedError
from lerobot_deltaco.policy.language.instruction_table import LanguageEncoderError
from lerobot_deltaco.policy.vision import VisionEncoderError
from lerobot_deltaco.training.loop import TrainingSetupError, train
from lerobot_deltaco.training.remote_job import RemoteJobError

# Errors whose messages a user can act on. Others are bugs, and show a traceback.
_ACTIONABLE = (
    UnsupportedLeRobotError,
    TrainingSetupError,
    TrainingDivergedError,
    ParsingError,
    RemoteJobError,
    LanguageEncoderError,
    VisionEncoderError,
)


def main() -> None:
    """Trains. The arguments are those of `lerobot-train`."""
    try:
        train()
    except _ACTIONABLE as error:
        sys.exit(f"deltaco-train: {reason_of(error)}")
    except KeyboardInterrupt:
        sys.stderr.write("\ndeltaco-train: Interrupted. Go on from a saved checkpoint with --resume=true.\n")
        sys.exit(130)
    except SystemExit as end:
        # LeRobot ends the command when its parser fails, without the reason.
        if not isinstance(end.__context__, ParsingError):
            raise
        sys.exit(f"deltaco-train: {reason_of(end.__context__)}")


if __name__ == "__main__":
    main()

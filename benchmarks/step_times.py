"""Times of the steps of a training: `python benchmarks/step_times.py FILE --policy.type=deltaco ...`.

It trains as `deltaco-train` does with the same arguments, and writes to the JSON file, for each step, when it
ended and the processor seconds of the process until then. `minute.py` and `small_trainings.py` start it, the
latter also by `torchrun`; of several processes, the first writes the file. It is a script of its own because
its `--steps` would be taken for that of `processes.py`.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

from lerobot.scripts import lerobot_train

from lerobot_deltaco.training.loop import InMemoryTraining


def main() -> None:
    """Trains, and writes the file."""
    times = Path(sys.argv[1])
    sys.argv = ["deltaco-train", *sys.argv[2:]]
    update = lerobot_train.update_policy
    ends: list[tuple[float, float]] = []

    def timed(*positional: Any, **named: Any) -> Any:
        result = update(*positional, **named)
        ends.append((time.perf_counter(), time.process_time()))
        return result

    with patch.object(lerobot_train, "update_policy", timed), InMemoryTraining().active():
        lerobot_train.main()
    if os.environ.get("RANK", "0") == "0":
        times.write_text(json.dumps(ends))


if __name__ == "__main__":
    main()

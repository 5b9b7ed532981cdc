"""What the demo's commands import, imported by the process that they are forked from."""

from contextlib import suppress
from importlib import import_module

NAMES = (
    "lerobot.scripts.lerobot_eval",
    "lerobot.scripts.lerobot_train",
    "lerobot_deltaco.data.collection",
    "lerobot_deltaco.evaluation.sets",
    "lerobot_deltaco.training.loop",
    "lerobot_policy_deltaco",
)

for _name in NAMES:
    # What fails here fails again in the command that needs it, which then says why.
    with suppress(Exception):
        import_module(_name)

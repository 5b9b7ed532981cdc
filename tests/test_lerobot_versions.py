"""What depends on LeRobot's version."""

import pytest
from lerobot.common import train_utils
from lerobot.scripts import lerobot_train

from lerobot_deltaco.lerobot_versions import replaced


def test_functions_of_the_training_script_are_replaced_in_a_context(monkeypatch):
    # A function since LeRobot 0.6.2
    monkeypatch.setattr(train_utils, "generate_model_card", lambda name: f"LeRobot's card of {name}", False)
    own = lerobot_train.cycle, train_utils.generate_model_card
    with replaced(make_card=lambda their, name: f"not {their(name)}", cycle=iter):
        assert lerobot_train.cycle is iter
        assert train_utils.generate_model_card("act") == "not LeRobot's card of act"
    assert (lerobot_train.cycle, train_utils.generate_model_card) == own


def test_a_version_without_a_function_is_refused():
    message = "has no shuffle_frames. Install a version that was tried"
    with pytest.raises(ImportError, match=message), replaced(make_card=print, shuffle_frames=print):
        pass

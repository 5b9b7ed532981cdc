"""The page of `deltaco-play` as a Space: it starts with the project's own checkpoint."""

from lerobot_deltaco.play.checkpoints import DEFAULT_NAME, checkpoints_folder
from lerobot_deltaco.play.engine import Engine
from lerobot_deltaco.play.page import build_page, launch_options

# Visitors load other checkpoints from the Hub alone, never from this machine's folders.
engine = Engine(str(checkpoints_folder() / DEFAULT_NAME), [checkpoints_folder()], is_hub_allowed=True)
demo = build_page(engine)
engine.start()

if __name__ == "__main__":
    demo.launch(**launch_options())

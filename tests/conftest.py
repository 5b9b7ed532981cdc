"""The default tests need neither a network nor a GPU, and leave the user's caches alone."""

import os

# Before anything imports huggingface_hub, which reads it once. `HF_HUB_OFFLINE=0 pytest -m hub` goes online.
for name in ("HF_HUB_OFFLINE", "HF_DATASETS_OFFLINE", "TRANSFORMERS_OFFLINE"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("WANDB_MODE", "disabled")

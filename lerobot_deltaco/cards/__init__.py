"""The cards of datasets and policies on the Hugging Face Hub."""

"""Instructions as embeddings: frozen sentence encoders, and sentences that people wrote."""

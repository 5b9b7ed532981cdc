"""Tables, figures and the leaderboard, made from the records of evaluations."""

"""The results of a session: stored measurements, overviews, verdicts on the set-up, trends."""

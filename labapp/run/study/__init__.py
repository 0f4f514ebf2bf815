"""A study: many recordings measured alike, on all cores or a cluster, and compared (`Study`)."""

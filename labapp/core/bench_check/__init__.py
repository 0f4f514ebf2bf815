"""The bench check: pictures of mirrors of known shape adjust the set-up (bundle adjustment)."""

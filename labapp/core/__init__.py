"""The measurement: pure functions on frozen values of arrays, from a frame to a surface."""

"""The surface under the reflections: splines, fit, level, boundary, sizes."""

"""The bench: laser, rays, imaging plane; coordinates of image, plane and work piece."""

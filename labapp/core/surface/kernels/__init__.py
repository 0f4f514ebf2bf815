"""Inner loops of the fit and of what is computed from it, compiled (docs/adr/0018).

Arguments mean the same in all modules, all in the UCS and mm:

* ``grid``: low end, high end, step and number of cells of the splines along x and along y, shape
  (2, 4) (`SplineBasis.grid`); with it ``coefficients`` of the splines, shape (p,).
* ``rays``: unit directions from the laser, shape (n, 3); ``points``: where they meet the surface.
* ``plane``: O′, the directions of O′X′ and O′Z′ and the normal of the imaging plane, and thickness
  and index of its glass, shape (5, 3) (`ImagingPlane.pose_mm`).
* ``outline``: the m points of the pool's boundary, shape (m, 3); ``boundary_slope``: gradient there
  of the surface's height over the boundary's, shape (m, 2).
* ``rear``: drop of the boundary, and where it starts and ends, shape (3,) (`Rear.as_array`).
* ``lower``, ``columns``: a lower band of shape (width + 1, p), as LAPACK has it, whose columns
  follow on each other in memory; and the same transposed.
* ``work``: scratch memory, which holds values and slopes of the four splines along x, then those
  along y, shape (4, 4).
"""

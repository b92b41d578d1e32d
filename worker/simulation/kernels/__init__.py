"""Warp kernels. Gradients are written out by hand: Warp's tape is silently wrong for loops that update locals.

Arguments end in `_in` or `_out`; `_inout` is read and written. Quaternions are x y z w here, and here only. Each module
compiles on first use and is cached on disk. The object frame of all kernels has its origin at the centre of mass.
"""

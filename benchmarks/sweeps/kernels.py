"""Kernels used only in comparisons."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def clear_contacts(
    active_in: wp.array(dtype=wp.int32), count_out: wp.array(dtype=wp.int32), near_count_out: wp.array(dtype=wp.int32)
):
    """Clear the contacts. Launch over B."""
    b = wp.tid()
    if active_in[b] == 1:
        count_out[b] = 0
        near_count_out[b] = 0

"""The functions on sixteen float32 side by side, by name, for kernels: they are made where a kernel is compiled."""

from derender.compilation.cache import late

LANES = 16

load, load_rounded, store, splat, steps_from, where_at_least, zero_sum, accumulate, sum_lanes = late(
    "derender.render.raycast.lanes", "load", "load_rounded", "store", "splat", "steps_from", "where_at_least",
    "zero_sum", "accumulate", "sum_lanes",
)  # fmt: skip
add, subtract, multiply, divide, maximum, minimum, multiply_add = late(
    "derender.render.raycast.lanes", "add", "subtract", "multiply", "divide", "maximum", "minimum", "multiply_add"
)
reciprocal, square_root, absolute, exponential, logarithm, log_of_sum = late(
    "derender.render.raycast.lanes", "reciprocal", "square_root", "absolute", "exponential", "logarithm", "log_of_sum"
)
new_window, push, blur_window, blur_along_row = late(
    "derender.render.raycast.lanes", "new_window", "push", "blur_window", "blur_along_row"
)

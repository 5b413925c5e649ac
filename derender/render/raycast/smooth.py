"""The blur of Eq. 6 in compiled float64, inside a rectangle, also of derivatives."""

from derender.compilation.cache import njit


@njit(cache=True, nogil=True)
def blur_rectangle(image, taps, rectangle, scratch, blurred):
    """Write the blurred image inside a rectangle (its margin is read from `image`, edges replicated).

    image, blurred, scratch : (H, W) float64, different arrays. taps : (R + 1,) float64 from the centre outwards.
    rectangle : (4,) int64, first column, end column, first row, end row.
    """
    height, width = image.shape
    radius = taps.shape[0] - 1
    c0, c1, r0, r1 = rectangle[0], rectangle[1], rectangle[2], rectangle[3]
    for row in range(max(r0 - radius, 0), min(r1 + radius, height)):
        left, right = max(c0, min(radius, c1)), min(c1, max(width - radius, c0))
        for column in range(c0, c1):
            scratch[row, column] = taps[0] * image[row, column]
        for k in range(1, radius + 1):
            tap = taps[k]
            for column in range(c0, min(left, c1)):
                scratch[row, column] += tap * (image[row, max(column - k, 0)] + image[row, min(column + k, width - 1)])
            for column in range(left, right):
                scratch[row, column] += tap * (image[row, column - k] + image[row, column + k])
            for column in range(max(right, left), c1):
                scratch[row, column] += tap * (image[row, max(column - k, 0)] + image[row, min(column + k, width - 1)])
    for row in range(r0, r1):
        for column in range(c0, c1):
            blurred[row, column] = taps[0] * scratch[row, column]
        for k in range(1, radius + 1):
            tap, above, below = taps[k], max(row - k, 0), min(row + k, height - 1)
            for column in range(c0, c1):
                blurred[row, column] += tap * (scratch[above, column] + scratch[below, column])

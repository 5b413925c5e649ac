"""How many answers end trusted: samples of `tabletop`, inferred with the defaults, at three sizes of image.

Called by scripts/evaluate.py: python scripts/evaluate.py trust -n 100
"""

import time

import numpy as np

import derender

SIZES = ((160, 120), (640, 480), (1280, 720))
LARGE_SHARE = 0.2  # of the frames at 160 x 120 that are also inferred at the larger sizes, which take longer


def evaluate_trust(count, first, verbose):
    """Print a table of how many of `count` samples end trusted, and the reasons why others do not."""
    reasons = []
    print("| pixels | frames | trusted | seconds, median |\n|---|---|---|---|")
    for width, height in SIZES:
        camera, some = derender.Camera.from_field_of_view(width, height), count
        if (width, height) != SIZES[0]:
            some = max(1, round(LARGE_SHARE * count))
        trusted, seconds = 0, []
        for seed in range(first, first + some):
            image = derender.sample("tabletop", seed=seed, camera=camera).render(noise=True, seed=seed)
            started = time.perf_counter()
            posterior = derender.infer(image, seed=seed)
            seconds.append(time.perf_counter() - started)
            trusted += bool(posterior.trusted)
            if not posterior.trusted:
                reasons.append(f"{width} x {height}, seed {seed}: {'; '.join(posterior.doubts)}")
            if verbose:
                print(seed, posterior.trusted, round(seconds[-1], 2), posterior.structures[0].words, flush=True)
        print(f"| {width} x {height} | {some} | {trusted} | {np.median(seconds):.1f} |", flush=True)
    for reason in reasons:
        print(reason)

"""Probabilities as people may read them: no finer than their error, and never certain."""

SURE = 0.99  # no probability is said to be surer than that: what a search has missed it cannot know
OPEN = 0.02  # width of an interval from which on it is said
COARSE = 0.1  # standard error from which on one digit has to do


def probability_text(probability: float, error: float = 0.0, interval: tuple[float, float] | None = None) -> str:
    """Return a probability in words: ".93 (.88-.96)", ">.99", "<.01".

    error : its standard error. interval : in which it lies with 90 %; None: by the error.
    """
    low, high = (probability - 1.64 * error, probability + 1.64 * error) if interval is None else interval
    low, high = max(low, 0.0), min(high, 1.0)
    text = digits(probability, 1 if error >= COARSE else 2)
    return f"{text} ({digits(low)}-{digits(high)})" if high - low >= OPEN else text


def digits(probability: float, count: int = 2) -> str:
    """Return a probability with so many digits behind the point, or that it is beyond those."""
    if probability > SURE:
        return f">{SURE:.2f}".replace("0.", ".")
    if probability < 1.0 - SURE:
        return f"<{1.0 - SURE:.2f}".replace("0.", ".")
    text = f"{probability:.{count}f}"
    return text.removeprefix("0") if text != "1.0" else f">{1.0 - 10.0**-count:.{count}f}".replace("0.", ".")

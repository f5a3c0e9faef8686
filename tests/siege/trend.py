"""The slope of a measured quantity over time, with its confidence interval."""

import dataclasses
import math
import statistics

# The samples are divided into blocks, whose medians are fitted. Neighboring samples are correlated, medians of blocks
# hardly.
BLOCKS = 12

# Quantile 97.5 % of Student's t distribution with BLOCKS - 2 degrees of freedom.
T_QUANTILE = 2.228


@dataclasses.dataclass
class Trend:
    """A slope per second and half the width of its 95 % confidence interval."""

    slope: float
    uncertainty: float

    def low(self):
        return self.slope - self.uncertainty

    def high(self):
        return self.slope + self.uncertainty


def fit(samples):
    """The trend of samples (time in seconds, value), at least two per block."""
    size = len(samples) / BLOCKS
    if size < 2:
        raise ValueError(f"expected at least {2 * BLOCKS} samples, got {len(samples)}")
    blocks = [samples[int(index * size) : int((index + 1) * size)] for index in range(BLOCKS)]
    times = [statistics.mean(time for time, _ in block) for block in blocks]
    values = [statistics.median(value for _, value in block) for block in blocks]
    line = statistics.linear_regression(times, values)
    errors = [value - line.slope * time - line.intercept for time, value in zip(times, values)]
    mean_time = statistics.mean(times)
    spread = sum((time - mean_time) ** 2 for time in times)
    deviation = math.sqrt(sum(error**2 for error in errors) / (BLOCKS - 2) / spread)
    return Trend(line.slope, T_QUANTILE * deviation)

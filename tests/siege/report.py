"""Results of the checks."""

import dataclasses


@dataclasses.dataclass
class Result:
    """One check in the report. `item` is its number in `prove.ITEMS`."""

    item: int
    promise: str
    required: str
    measured: str
    passed: bool
    # The negative control: what the same check found where it must fail, and whether it failed there.
    control: str
    control_failed: bool

    def is_good(self):
        return self.passed and self.control_failed

    def line(self):
        verdict = "pass" if self.passed else "FAIL"
        control = "fails, as it must" if self.control_failed else "PASSES, so the check proves nothing"
        return (
            f"{self.item:2}. {verdict}  {self.promise}\n"
            f"      required: {self.required}\n"
            f"      measured: {self.measured}\n"
            f"      control: {self.control}: {control}"
        )


def mb(count):
    """A number of bytes as text."""
    return f"{count / 1e6:.0f} MB"

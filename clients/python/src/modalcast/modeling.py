"""Modes of a surface, which the program `modalcast model` computes by the finite cell method."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypedDict, cast
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modalcast._server_process import find_program
from modalcast._types import F32, F64, U32, to_f64
from modalcast.errors import ModelingError, ServerStartError

ModelingProgress: TypeAlias = Callable[[float, str], object]
"""Called with the completed fraction, 0 to 1, and the name of the stage."""

Surface: TypeAlias = str | Path | tuple[ArrayLike, ArrayLike]
"""A file, or vertices (n x 3) and faces (m x 3 or m x 4)."""

OptionValue: TypeAlias = str | float | bool | Sequence[str] | None
"""The value of an option of the program. Each text of a sequence is a value of its own; True is a flag."""

_STOP_SECONDS = 10.0
_BAR_WIDTH = 40


@dataclass(frozen=True, eq=False)
class ModalModel:
    """A surface with its modes. The first four attributes are arguments of `SceneBuilder.add`.

    Lengths are in meters. Z is up, so a scene has `SceneBuilder(name, up="z")`.

    Attributes:
        positions: Rest positions of the n vertices, n x 3.
        faces: Vertices of the triangles, m x 3.
        modes: U, n x 3 x r, mass-normalized: in 1/sqrt(kg), so that q is in m sqrt(kg).
        eigenvalues: Squared angular frequencies in (rad/s)^2, in ascending order.
        frequency_errors: Estimated relative error of each frequency; NaN if there is no estimate.
        mass: In kg, with point masses.
        size: Extent along x, y and z in meters.
        rigid_modes: Number of rigid modes, which are not among the r modes: six per free part.
        parts: Number of parts that are not connected.
        freedoms: Number of unknowns of the computation.
        remarks: Warnings about the surface and the result.
        notes: What the file says about its origin: material, damping, unit and others.
    """

    positions: F64
    faces: U32
    modes: F32
    eigenvalues: F64
    frequency_errors: F64
    mass: float
    size: tuple[float, float, float]
    rigid_modes: int
    parts: int
    freedoms: int
    remarks: tuple[str, ...]
    notes: dict[str, str]

    @property
    def frequencies(self) -> F64:
        """Frequencies of the modes in Hz."""
        return np.sqrt(np.maximum(self.eigenvalues, 0.0)) / (2 * np.pi)


class _Report(TypedDict):
    """The JSON output of the program."""

    freedoms: int
    parts: int
    rigid_modes: int
    mass: float
    size: tuple[float, float, float]
    frequency_errors: list[float | None]
    remarks: list[str]


class Computation:
    """One run of the program `modalcast model`."""

    def __init__(
        self,
        source: Surface,
        options: Mapping[str, OptionValue],
        *,
        point_masses: ArrayLike | None,
        out: str | Path | None,
        overwrite: bool,
        program: str | Path | None,
    ) -> None:
        """Checks the arguments, and starts nothing.

        Raises:
            ModelingError: The program does not exist.
            ValueError: An array has another shape, or cubic forces have no file.
        """
        if options.get("large") and out is None:
            raise ValueError("out: expected a file, beside which large=True writes cubic forces, got None")
        try:
            self._program = find_program(program)
        except ServerStartError as error:
            raise ModelingError(str(error)) from error
        self._source = source if isinstance(source, tuple) else Path(source)
        if isinstance(self._source, tuple):
            vertices, faces = self._source
            self._source = (to_f64("vertices", vertices, (None, 3)), _polygons(faces))
        self._flags = _flags({**options, "point-mass": _point_mass_texts(point_masses)})
        self._out = None if out is None else Path(out)
        self._overwrite = overwrite
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._is_canceled = False

    def run(self, progress: bool | ModelingProgress) -> ModalModel:
        """Runs the program until it ends. An exception in this thread, such as KeyboardInterrupt, ends the program.

        Raises:
            ModelingError: The program failed; the message is its own.
        """
        if progress is True:
            with contextlib.closing(_ProgressLine()) as line:
                return self._run(line)
        return self._run(progress or None)

    def cancel(self) -> None:
        """Ends the program, whose `run` raises ModelingError. Other threads may call this."""
        with self._lock:
            self._is_canceled = True
            if self._process is not None:
                self._process.terminate()

    def _run(self, progress: ModelingProgress | None) -> ModalModel:
        with tempfile.TemporaryDirectory(prefix="modalcast-", ignore_cleanup_errors=True) as folder_name:
            folder = Path(folder_name)
            if isinstance(self._source, tuple):
                path = folder / "surface.npz"
                np.savez(path, vertices=self._source[0], faces=self._source[1])
            else:
                path = self._source
            out = self._out or folder / "model.npz"
            command = [self._program, "model", *self._flags, f"--out={out}", "--json", "--progress=lines"]
            command += ["--force"] if self._overwrite else []
            output = folder / "output"
            self._execute([*command, "--", str(path)], output, progress)
            return _read_model(out, output.read_text(errors="replace"))

    def _execute(self, command: list[str], output: Path, progress: ModelingProgress | None) -> None:
        with output.open("wb") as standard_output, self._lock:
            if self._is_canceled:
                raise ModelingError("canceled")
            # A session of its own: Ctrl-C reaches this process, which ends the program.
            try:
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=standard_output,
                    stderr=subprocess.PIPE,
                    text=True,
                    errors="replace",
                    start_new_session=True,
                )
            except OSError as error:
                raise ModelingError(f"{command[0]}: {error}") from error
            self._process = process
        messages: list[str] = []
        try:
            assert process.stderr is not None
            for line in process.stderr:
                completed = _progress_of(line)
                if completed is None:
                    messages.append(line.rstrip())
                elif progress is not None:
                    progress(*completed)
            code = process.wait()
        except BaseException:
            _end(process)
            raise
        finally:
            if process.stderr is not None:
                process.stderr.close()
        if self._is_canceled:
            raise ModelingError("canceled")
        if code != 0:
            message = "\n".join(messages).removeprefix("error: ").removeprefix("modalcast: ")
            raise ModelingError(message or f"{self._program} model ended with exit code {code}")


class _ProgressLine:
    """Shows the progress in one line of standard error."""

    def __init__(self) -> None:
        self._length = 0

    def __call__(self, fraction: float, stage: str) -> None:
        bar = "#" * round(_BAR_WIDTH * fraction)
        self._write(f"[{bar:<{_BAR_WIDTH}}] {fraction:4.0%} {stage}")

    def close(self) -> None:
        """Clears the line."""
        self._write("")
        print("\r", end="", file=sys.stderr, flush=True)

    def _write(self, text: str) -> None:
        print(f"\r{text:<{self._length}}", end="", file=sys.stderr, flush=True)
        self._length = len(text)


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.wait(_STOP_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _flags(options: Mapping[str, OptionValue]) -> list[str]:
    """The flags of the options that are not None. A value can start with '-', so its flag is in the same argument."""
    flags: list[str] = []
    for name, value in options.items():
        if isinstance(value, bool):
            flags += [f"--{name}"] if value else []
            continue
        values = [value] if isinstance(value, (str, int, float, np.generic)) else value or ()
        flags += [f"--{name}={item}" for item in values]
    return flags


def _point_mass_texts(point_masses: ArrayLike | None) -> list[str] | None:
    if point_masses is None:
        return None
    rows = cast("list[list[float]]", to_f64("point_masses", point_masses, (None, 4)).tolist())
    return [" ".join(map(repr, row)) for row in rows]


def _polygons(faces: ArrayLike) -> NDArray[np.integer[Any]]:
    given: NDArray[Any] = np.asarray(faces)
    if given.ndim != 2 or given.shape[1] not in (3, 4):
        raise ValueError(f"faces: expected shape (m, 3) or (m, 4), got {given.shape}")
    if given.dtype.kind not in "iu":
        raise ValueError(f"faces: expected integers, got the type {given.dtype}")
    return given


def _progress_of(line: str) -> tuple[float, str] | None:
    """Fraction and stage of a line `progress 0.350 factorization`; None for another line."""
    words = line.split(maxsplit=2)
    if len(words) == 3 and words[0] == "progress":
        with contextlib.suppress(ValueError):
            return float(words[1]), words[2].rstrip()
    return None


def _read_model(path: Path, output: str) -> ModalModel:
    try:
        report = cast("_Report", json.loads(output))
        with np.load(path, allow_pickle=False) as arrays:
            notes = bytes(arrays["notes"]).decode() if "notes" in arrays else "{}"
            errors = [np.nan if error is None else error for error in report["frequency_errors"]]
            x, y, z = report["size"]
            return ModalModel(
                positions=arrays["vertices"],
                faces=arrays["faces"],
                modes=arrays["U"],
                eigenvalues=arrays["eigenvalues"],
                frequency_errors=np.array(errors, np.float64),
                mass=report["mass"],
                size=(x, y, z),
                rigid_modes=report["rigid_modes"],
                parts=report["parts"],
                freedoms=report["freedoms"],
                remarks=tuple(report["remarks"]),
                notes=cast("dict[str, str]", json.loads(notes)),
            )
    except (KeyError, ValueError, TypeError, OSError, BadZipFile) as error:
        raise ModelingError(f"expected a report and a model of this version of modalcast: {error!r}") from error

"""Compares modalcast with the peer, the moderngl program of draw.py. Writes their times to peers.json, and an image per scene
with three parts side by side: the frame of modalcast, the frame of the peer, and four times their difference.
"""

import json
import struct
import sys
import zlib
from pathlib import Path

import numpy as np

from mesh import write_png


def read_png(path):
    """Decodes an 8-bit RGB PNG without interlacing, as both programs write it."""
    data, offset, compressed = Path(path).read_bytes(), 8, b""
    while offset < len(data):
        length, kind = struct.unpack(">I4s", data[offset : offset + 8])
        chunk = data[offset + 8 : offset + 8 + length]
        if kind == b"IHDR":
            width, height, depth, color = struct.unpack(">IIBB", chunk[:10])
            assert (depth, color) == (8, 2), f"{path}: expected 8-bit RGB, got {depth} bits of color type {color}"
        elif kind == b"IDAT":
            compressed += chunk
        offset += 12 + length
    raw, stride = zlib.decompress(compressed), 3 * width
    rows, above = np.zeros((height, stride), np.uint8), np.zeros(stride, np.uint8)
    for row in range(height):
        filter_type = raw[row * (stride + 1)]
        line = np.frombuffer(raw, np.uint8, stride, row * (stride + 1) + 1).copy()
        rows[row] = above = undo_filter(filter_type, line, above)
    return rows.reshape(height, width, 3)


def undo_filter(filter_type, line, above):
    """Reverses the PNG filter of one row; `above` is the unfiltered row above it.

    Filter types: 0 none, 1 left neighbor, 2 row above, 3 mean of both, 4 Paeth.
    """
    if filter_type == 0:
        return line
    if filter_type == 2:
        return line + above
    row, line, above = np.zeros(len(line) + 3, np.int64), line.astype(np.int64), above.astype(np.int64)
    # `row` starts with a zero pixel of three bytes, so byte i of the line is row[i + 3] and its left neighbor row[i].
    for i in range(len(line)):
        left, above_left = row[i], above[i - 3] if i >= 3 else 0
        if filter_type == 1:
            prediction = left
        elif filter_type == 3:
            prediction = (left + above[i]) // 2
        else:
            paeth = left + above[i] - above_left
            prediction = min((left, above[i], above_left), key=lambda value: abs(paeth - value))
        row[i + 3] = (line[i] + prediction) & 255
    return row[3:].astype(np.uint8)


def median_round(timings):
    """The timing of the round whose median time is the median of all rounds."""
    return sorted(timings, key=lambda timing: timing["median_us"])[len(timings) // 2]


def main(out, folders):
    """Compares the rounds in `folders`, one folder each. The images are those of the last round."""
    out, rounds = Path(out), []
    for folder in map(Path, folders):
        rounds.append(tuple(json.loads((folder / name).read_text()) for name in ("times.json", "peer.json")))
    (ours, peer), last_folder, rows = rounds[-1], Path(folders[-1]), []
    for index, scene in enumerate(ours["scenes"]):
        name = scene["name"]
        our_image, peer_image = read_png(last_folder / f"{name}.png"), read_png(last_folder / f"{name}-peer.png")
        difference = np.abs(our_image.astype(int) - peer_image).max(axis=2)
        amplified = np.repeat(np.clip(4 * difference, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        write_png(out / f"{name}-beside.png", np.concatenate([our_image, peer_image, amplified], axis=1))
        # "whole" is the time of a frame with its pixels in host memory.
        our_times = [our_round["scenes"][index]["whole"] for our_round, _ in rounds]
        peer_times = [peer_round["scenes"][name]["whole"] for _, peer_round in rounds]
        ratios = [peer_time["median_us"] / our_time["median_us"] for our_time, peer_time in zip(our_times, peer_times)]
        rows.append({
            "shadow": name, "triangles": scene["triangles"], "map": scene["look"]["shadow"]["size"], "samples": scene["samples"],
            "ours_us": {"with_pixels": median_round(our_times)},
            "peer_us": {"with_pixels": median_round(peer_times)},
            "rounds": [{"ours_us": our_time, "peer_us": peer_time} for our_time, peer_time in zip(our_times, peer_times)],
            "peer_over_ours": float(np.median(ratios)), "peer_over_ours_by_round": ratios,
            "mean_difference_of_255": float(difference.mean()), "pixels_apart_by_more_than_16": float((difference > 16).mean()),
        })
        print("%-10s ours %9.1f us, peer %9.1f us with pixels: %.2f times; mean difference %.2f of 255" % (
            name, median_round(our_times)["median_us"], median_round(peer_times)["median_us"], rows[-1]["peer_over_ours"], difference.mean()))
    provenance = ours["made"]
    report = {
        "what": "Times of modalcast and of a plain moderngl program for one mesh and view, with shadow maps of equal size and "
        "4 samples a pixel. Microseconds by the wall clock, of a frame with its pixels in host memory. The programs alternate "
        "in three rounds: with_pixels is the round with the median time, peer_over_ours the median of the ratios.",
        "command": "tests/bench/peers/run", "commit": provenance["commit"], "size": ours["size"],
        "machine": {"cpu": provenance["cpu"], "threads": provenance["threads"], "release": provenance["release"]},
        "renderer": ours["renderer"], "peer": {key: peer[key] for key in ("renderer", "moderngl")},
        "differs": [
            "modalcast shades each visible triangle of a pixel once, in a compute shader; the peer shades all fragments",
            "filtered: modalcast weights 4 x 4 depths by a Gaussian of 0.33 texels; the peer takes 3 x 3 bilinear comparisons",
            "modalcast filters images anisotropically if the device supports it; both programs use mip levels",
            "modalcast fits the light's box in each frame, snaps it to texels and widens it by the blur; the peer fits it once",
            "modalcast averages the samples of a pixel before the sRGB encoding, the peer after it",
        ],
        "rows": rows,
    }
    (out / "peers.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])

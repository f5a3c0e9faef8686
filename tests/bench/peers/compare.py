"""Times of both programs in one file, and their pictures side by side: ours, the peer's, and four times the difference."""

import json
import struct
import sys
import zlib
from pathlib import Path

import numpy as np

from mesh import png


def read(path):
    """An RGB PNG of 8 bits without interlacing, as both programs write it."""
    data, at, body = Path(path).read_bytes(), 8, b""
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        part = data[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack(">IIBB", part[:10])
            assert (depth, colour) == (8, 2), "an RGB picture of 8 bits"
        elif kind == b"IDAT":
            body += part
        at += 12 + length
    raw, stride = zlib.decompress(body), 3 * width
    rows, last = np.zeros((height, stride), np.uint8), np.zeros(stride, np.uint8)
    for row in range(height):
        kind, line = raw[row * (stride + 1)], np.frombuffer(raw, np.uint8, stride, row * (stride + 1) + 1).copy()
        rows[row] = last = unfiltered(kind, line, last)
    return rows.reshape(height, width, 3)


def unfiltered(kind, line, above):
    if kind == 0:
        return line
    if kind == 2:
        return line + above
    own, line, above = np.zeros(len(line) + 3, np.int64), line.astype(np.int64), above.astype(np.int64)
    for at in range(len(line)):
        left, corner = own[at], above[at - 3] if at >= 3 else 0
        if kind == 1:
            guess = left
        elif kind == 3:
            guess = (left + above[at]) // 2
        else:
            toward = left + above[at] - corner
            guess = min((left, above[at], corner), key=lambda value: abs(toward - value))
        own[at + 3] = (line[at] + guess) & 255
    return own[3:].astype(np.uint8)


def middle(timings):
    """The round whose median is the middle one."""
    return sorted(timings, key=lambda timing: timing["median_us"])[len(timings) // 2]


def main(out, folders):
    out, rounds = Path(out), []
    for folder in map(Path, folders):
        rounds.append(tuple(json.loads((folder / name).read_text()) for name in ("times.json", "peer.json")))
    (ours, peer), last, rows = rounds[-1], Path(folders[-1]), []
    for at, scene in enumerate(ours["scenes"]):
        name = scene["name"]
        own, other = read(last / f"{name}.png"), read(last / f"{name}-peer.png")
        apart = np.abs(own.astype(int) - other).max(axis=2)
        loud = np.repeat(np.clip(4 * apart, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        png(out / f"{name}-beside.png", np.concatenate([own, other, loud], axis=1))
        whole = middle([one["scenes"][at]["whole"] for one, _ in rounds])
        theirs = {key: middle([other["scenes"][name][key] for _, other in rounds]) for key in ("frame", "whole")}
        frame = [next(own["timing"] for own in one["scenes"][at]["passes"] if own["name"] == "frame") for one, _ in rounds]
        rows.append({
            "shadow": name, "triangles": scene["triangles"], "map": scene["look"]["shadow"]["size"], "samples": scene["samples"],
            "ours_us": {"frame": middle(frame), "with_pixels": whole},
            "peer_us": {"frame": theirs["frame"], "with_pixels": theirs["whole"]},
            "peer_over_ours": theirs["whole"]["median_us"] / whole["median_us"],
            "peer_over_ours_by_round": [
                other["scenes"][name]["whole"]["median_us"] / one["scenes"][at]["whole"]["median_us"] for one, other in rounds
            ],
            "mean_difference_of_255": float(apart.mean()), "pixels_apart_by_more_than_16": float((apart > 16).mean()),
        })
        print("%-10s ours %9.1f us, peer %9.1f us with pixels: %.2f times; mean difference %.2f of 255" % (
            name, whole["median_us"], theirs["whole"]["median_us"], rows[-1]["peer_over_ours"], apart.mean()))
    made = ours["made"]
    together = {
        "what": "one mesh, one view, a shadow map of equal size and 4 samples a pixel, by modalcast and by a plain moderngl "
        "program; microseconds, medians of the middle of three rounds taken in turns; with_pixels is the wall clock around a frame and its pixels in host memory",
        "command": "tests/bench/peers/run", "commit": made["commit"], "size": ours["size"],
        "machine": {"cpu": made["cpu"], "threads": made["threads"], "release": made["release"]},
        "renderer": ours["renderer"], "peer": {key: peer[key] for key in ("renderer", "moderngl")},
        "differs": [
            "ours shades each triangle once a pixel in compute from ids, the peer each triangle's fragments as they come",
            "filtered: ours weighs 4 x 4 depths with a Gaussian of 0.33 texels, the peer 3 x 3 comparisons between 4 texels",
            "ours samples images anisotropically where the device does; both have mip levels",
            "ours snaps the light's box to texels and widens it by the blur; the peer fits the vertices once, before the clock",
            "ours blends samples as light and then encodes, the peer encodes and then blends",
        ],
        "rows": rows,
    }
    (out / "peers.json").write_text(json.dumps(together, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])

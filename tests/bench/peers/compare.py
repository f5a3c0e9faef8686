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
        whole = [one["scenes"][at]["whole"] for one, _ in rounds]
        theirs = [other["scenes"][name]["whole"] for _, other in rounds]
        ratios = [other["median_us"] / one["median_us"] for one, other in zip(whole, theirs)]
        rows.append({
            "shadow": name, "triangles": scene["triangles"], "map": scene["look"]["shadow"]["size"], "samples": scene["samples"],
            "ours_us": {"with_pixels": middle(whole)},
            "peer_us": {"with_pixels": middle(theirs)},
            "rounds": [{"ours_us": one, "peer_us": other} for one, other in zip(whole, theirs)],
            "peer_over_ours": float(np.median(ratios)), "peer_over_ours_by_round": ratios,
            "mean_difference_of_255": float(apart.mean()), "pixels_apart_by_more_than_16": float((apart > 16).mean()),
        })
        print("%-10s ours %9.1f us, peer %9.1f us with pixels: %.2f times; mean difference %.2f of 255" % (
            name, middle(whole)["median_us"], middle(theirs)["median_us"], rows[-1]["peer_over_ours"], apart.mean()))
    made = ours["made"]
    together = {
        "what": "one mesh, one view, a shadow map of equal size and 4 samples a pixel, by modalcast and by a plain moderngl "
        "program; microseconds, by the wall clock around a frame and its pixels in host memory for both; with_pixels is the "
        "middle of three rounds taken in turns, peer_over_ours the median of the ratios of the rounds",
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

"""Times of both programs in one file, and their pictures side by side: ours, the peer's, and four times the difference."""

import json
import struct
import sys
import zlib
from pathlib import Path

import numpy as np

from mesh import write_png


def read_png(path):
    """An RGB PNG of 8 bits without interlacing, as both programs write it."""
    data, offset, body = Path(path).read_bytes(), 8, b""
    while offset < len(data):
        length, kind = struct.unpack(">I4s", data[offset : offset + 8])
        chunk = data[offset + 8 : offset + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack(">IIBB", chunk[:10])
            assert (depth, colour) == (8, 2), f"{path}: expected 8-bit RGB, got {depth} bits of color type {colour}"
        elif kind == b"IDAT":
            body += chunk
        offset += 12 + length
    raw, stride = zlib.decompress(body), 3 * width
    rows, last = np.zeros((height, stride), np.uint8), np.zeros(stride, np.uint8)
    for row in range(height):
        kind, line = raw[row * (stride + 1)], np.frombuffer(raw, np.uint8, stride, row * (stride + 1) + 1).copy()
        rows[row] = last = undo_filter(kind, line, last)
    return rows.reshape(height, width, 3)


def undo_filter(kind, line, above):
    """Reverses the PNG filter of one row."""
    if kind == 0:
        return line
    if kind == 2:
        return line + above
    row, line, above = np.zeros(len(line) + 3, np.int64), line.astype(np.int64), above.astype(np.int64)
    # `row` starts with one zero pixel, so byte i of the row is row[i + 3].
    for i in range(len(line)):
        left, corner = row[i], above[i - 3] if i >= 3 else 0
        if kind == 1:
            prediction = left
        elif kind == 3:
            prediction = (left + above[i]) // 2
        else:
            paeth = left + above[i] - corner
            prediction = min((left, above[i], corner), key=lambda value: abs(paeth - value))
        row[i + 3] = (line[i] + prediction) & 255
    return row[3:].astype(np.uint8)


def median_round(timings):
    """The timing of the round with the median of the medians."""
    return sorted(timings, key=lambda timing: timing["median_us"])[len(timings) // 2]


def main(out, folders):
    out, rounds = Path(out), []
    for folder in map(Path, folders):
        rounds.append(tuple(json.loads((folder / name).read_text()) for name in ("times.json", "peer.json")))
    (ours, peer), last, rows = rounds[-1], Path(folders[-1]), []
    for index, scene in enumerate(ours["scenes"]):
        name = scene["name"]
        own_image, peer_image = read_png(last / f"{name}.png"), read_png(last / f"{name}-peer.png")
        difference = np.abs(own_image.astype(int) - peer_image).max(axis=2)
        amplified = np.repeat(np.clip(4 * difference, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        write_png(out / f"{name}-beside.png", np.concatenate([own_image, peer_image, amplified], axis=1))
        own_times = [own["scenes"][index]["whole"] for own, _ in rounds]
        peer_times = [other["scenes"][name]["whole"] for _, other in rounds]
        ratios = [other["median_us"] / own["median_us"] for own, other in zip(own_times, peer_times)]
        rows.append({
            "shadow": name, "triangles": scene["triangles"], "map": scene["look"]["shadow"]["size"], "samples": scene["samples"],
            "ours_us": {"with_pixels": median_round(own_times)},
            "peer_us": {"with_pixels": median_round(peer_times)},
            "rounds": [{"ours_us": own, "peer_us": other} for own, other in zip(own_times, peer_times)],
            "peer_over_ours": float(np.median(ratios)), "peer_over_ours_by_round": ratios,
            "mean_difference_of_255": float(difference.mean()), "pixels_apart_by_more_than_16": float((difference > 16).mean()),
        })
        print("%-10s ours %9.1f us, peer %9.1f us with pixels: %.2f times; mean difference %.2f of 255" % (
            name, median_round(own_times)["median_us"], median_round(peer_times)["median_us"], rows[-1]["peer_over_ours"], difference.mean()))
    provenance = ours["made"]
    report = {
        "what": "one mesh, one view, a shadow map of equal size and 4 samples a pixel, by modalcast and by a plain moderngl "
        "program; microseconds, by the wall clock around a frame and its pixels in host memory for both; with_pixels is the "
        "middle of three rounds taken in turns, peer_over_ours the median of the ratios of the rounds",
        "command": "tests/bench/peers/run", "commit": provenance["commit"], "size": ours["size"],
        "machine": {"cpu": provenance["cpu"], "threads": provenance["threads"], "release": provenance["release"]},
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
    (out / "peers.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])

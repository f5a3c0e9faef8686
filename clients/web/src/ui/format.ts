/** Numbers for people. */

/** A number with three significant digits. */
export function short(value: number): string {
    if (value === 0) return "0";
    const size = Math.abs(value);
    if (!Number.isFinite(value)) return String(value);
    if (size >= 1e5 || size < 1e-3) return value.toExponential(1).replace("e+", "e");
    return Number(value.toPrecision(3)).toString();
}

export function meters(value: number): string {
    if (value === 0) return "0";
    const size = Math.abs(value);
    if (size < 1e-6) return `${short(value * 1e9)} nm`;
    if (size < 1e-3) return `${short(value * 1e6)} µm`;
    if (size < 1) return `${short(value * 1e3)} mm`;
    return size < 1e4 ? `${short(value)} m` : `${short(value / 1e3)} km`;
}

/** With a sign, unless the value is 0. */
export function signedMeters(value: number): string {
    if (value === 0) return meters(0);
    return `${value < 0 ? "−" : "+"}${meters(Math.abs(value))}`;
}

export function newtons(value: number): string {
    const size = Math.abs(value);
    if (size >= 1e6) return `${short(value / 1e6)} MN`;
    return size >= 1e3 ? `${short(value / 1e3)} kN` : `${short(value)} N`;
}

/** A force and its limit in newtons. The limit is null if it is unknown, and infinite if nothing bends. */
export function limitedNewtons(value: number, limit: number | null): string {
    if (limit === null) return `${newtons(value)}, limit unknown`;
    return Number.isFinite(limit) ? `${newtons(value)} of at most ${newtons(limit)}` : newtons(value);
}

export function frequency(hertz: number): string {
    if (hertz >= 1e6) return `${short(hertz / 1e6)} MHz`;
    return hertz >= 1e4 ? `${short(hertz / 1e3)} kHz` : `${short(hertz)} Hz`;
}

export function bytes(value: number): string {
    if (value < 1000) return `${Math.round(value)} B`;
    if (value < 1e6) return `${short(value / 1e3)} kB`;
    return value < 1e9 ? `${short(value / 1e6)} MB` : `${short(value / 1e9)} GB`;
}

/** A time in seconds. Times up to `largest` have the same unit. */
export function seconds(value: number, largest = value): string {
    if (largest >= 1 || largest <= 0) return `${value.toFixed(2)} s`;
    return largest >= 1e-3 ? `${(value * 1e3).toFixed(1)} ms` : `${(value * 1e6).toFixed(1)} µs`;
}

/** A time scale: seconds of a motion per second of real time. */
export function timeScale(ratio: number): string {
    if (Math.abs(ratio - 1) < 0.05) return "real time";
    return ratio <= 0.5 ? `1/${rounded(1 / ratio)} of real time` : `${rounded(ratio)}x real time`;
}

/** A selected speed: a fraction or a multiple of real time. */
export function speed(value: number): string {
    return value < 1 ? `1/${short(1 / value)}` : `${short(value)}x`;
}

/** A measured number with one significant digit if the difference is at most 3 %, or else with two. */
function rounded(value: number): string {
    const digit = Number(value.toPrecision(1));
    return String(Math.abs(digit / value - 1) <= 0.03 ? digit : Number(value.toPrecision(2)));
}

export function count(value: number | bigint): string {
    return value.toLocaleString("en-US");
}

/** Where an open scene comes from, as a sentence. `source`: see SceneInfo.source. */
export function sceneOrigin(source: string): string {
    const [, isUpload, file] = /^(uploaded)(?:: (.*))?$/.exec(source) ?? [];
    if (!isUpload) return source ? `Open now. The server has read it from ${source}.` : "Open now.";
    return file ? `Open now. It was sent to the server as ${file}.` : "Open now. It was sent to the server.";
}

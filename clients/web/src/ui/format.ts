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
    if (value === 0) return "0 m";
    const size = Math.abs(value);
    if (size < 1e-6) return `${short(value * 1e9)} nm`;
    if (size < 1e-3) return `${short(value * 1e6)} µm`;
    if (size < 1) return `${short(value * 1e3)} mm`;
    return size < 1e4 ? `${short(value)} m` : `${short(value / 1e3)} km`;
}

export function newtons(value: number): string {
    const size = Math.abs(value);
    if (size >= 1e6) return `${short(value / 1e6)} MN`;
    return size >= 1e3 ? `${short(value / 1e3)} kN` : `${short(value)} N`;
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

export function seconds(value: number): string {
    return `${value.toFixed(2)} s`;
}

export function count(value: number | bigint): string {
    return value.toLocaleString("en-US");
}

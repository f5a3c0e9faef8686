/** The numbers 1, 2 and 5 times a power of ten, at which scales end. */

/** A value that exceeds a nice number by rounding only counts as this number. */
const TOLERANCE = 1e-9;

/** The smallest nice number that is at least a positive value; 0 for other values. */
export function niceAbove(value: number): number {
    return neighbors(value).find((number) => number >= value * (1 - TOLERANCE)) ?? 0;
}

/** The largest nice number that is at most a positive value; 0 for other values. */
export function niceBelow(value: number): number {
    return neighbors(value).findLast((number) => number <= value * (1 + TOLERANCE)) ?? 0;
}

/** The nice numbers around a positive value, ascending. */
function neighbors(value: number): number[] {
    if (!(value > 0) || !Number.isFinite(value)) return [];
    const exponent = Math.floor(Math.log10(value));
    // 5 / 1000 is the number nearest to 0.005, and 5 * 10 ** -3 is not.
    return [exponent - 1, exponent, exponent + 1].flatMap((power) =>
        [1, 2, 5].map((digit) => (power < 0 ? digit / 10 ** -power : digit * 10 ** power)),
    );
}

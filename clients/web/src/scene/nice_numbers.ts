/** Round numbers, at which scales end: 1, 2 and 5 times a power of ten, and finer ones. */

/** A value that exceeds a nice number by rounding only counts as this number. */
const TOLERANCE = 1e-9;

/** Leading digits of the ends of scales that follow a motion. */
const FINE = [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8];

/** The smallest nice number that is at least a positive value; 0 for other values. */
export function niceAbove(value: number): number {
    return neighbors(value).find((number) => number >= value * (1 - TOLERANCE)) ?? 0;
}

/** The smallest number of finer steps that is at least a positive value: at most 4/3 of it. 0 for other values. */
export function fineAbove(value: number): number {
    return neighbors(value, FINE).find((number) => number >= value * (1 - TOLERANCE)) ?? 0;
}

/** The largest nice number that is at most a positive value; 0 for other values. */
export function niceBelow(value: number): number {
    return neighbors(value).findLast((number) => number <= value * (1 + TOLERANCE)) ?? 0;
}

/** The numbers with these leading digits around a positive value, ascending. */
function neighbors(value: number, digits: readonly number[] = [1, 2, 5]): number[] {
    if (!(value > 0) || !Number.isFinite(value)) return [];
    const exponent = Math.floor(Math.log10(value));
    // 5 / 1000 is the number nearest to 0.005, and 5 * 10 ** -3 is not.
    return [exponent - 1, exponent, exponent + 1].flatMap((power) =>
        digits.map((digit) => (power < 0 ? digit / 10 ** -power : digit * 10 ** power)),
    );
}

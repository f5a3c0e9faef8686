/** Model files that tests write: a beam as a NumPy archive or an STL file, and a bracket as an STL file. */

import { crc32 } from "node:zlib";

/** A square beam of length 1 along z. Its two modes bend it along x and y. */
export class Beam {
    private readonly sections = 9;
    private readonly corners: [number, number][] = [
        [-0.06, -0.06],
        [0.06, -0.06],
        [0.06, 0.06],
        [-0.06, 0.06],
    ];

    /** n x 3. */
    get vertices(): number[][] {
        return Array.from({ length: this.sections }, (_, section) =>
            this.corners.map(([x, y]) => [x, y, section / (this.sections - 1)]),
        ).flat();
    }

    /** m x 3. */
    get faces(): number[][] {
        const ring = [0, 1, 2, 3];
        const sides = Array.from({ length: this.sections - 1 }, (_, section) =>
            ring.flatMap((corner) => {
                const [a, b] = [4 * section + corner, 4 * section + ((corner + 1) % 4)];
                return [
                    [a, b, b + 4],
                    [a, b + 4, a + 4],
                ];
            }),
        );
        const top = 4 * (this.sections - 1);
        return [...sides.flat(), [0, 2, 1], [0, 3, 2], [top, top + 1, top + 2], [top, top + 2, top + 3]];
    }

    /** U, 3n x 2: the displacement is z^2 at height z, and the sections turn with the slope 2 z. */
    get modes(): number[][] {
        return this.vertices.flatMap(([x = 0, y = 0, z = 0]) => [
            [z * z, 0],
            [0, z * z],
            [-2 * z * x, -2 * z * y],
        ]);
    }

    /** @param eigenvalues Of the modes, in (rad/s)^2; null for none. */
    npz(eigenvalues: number[] | null): Buffer {
        const arrays: Record<string, Buffer> = {
            vertices: npy(this.vertices),
            faces: npy(this.faces),
            U: npy(this.modes),
        };
        if (eigenvalues)
            arrays["eigenvalues"] = npy(
                eigenvalues.map((value) => [value]),
                true,
            );
        return zip(Object.fromEntries(Object.entries(arrays).map(([name, array]) => [`${name}.npy`, array])));
    }

    stl(): string {
        const vertices = this.vertices;
        return stl(this.faces.map((face) => face.map((vertex) => vertices[vertex] ?? [])));
    }
}

/** @param triangles Three corners each. */
function stl(triangles: number[][][]): string {
    const facet = (corners: number[][]) =>
        `facet normal 0 0 0\nouter loop\n${corners
            .map((corner) => `vertex ${corner.join(" ")}\n`)
            .join("")}endloop\nendfacet\n`;
    return `solid part\n${triangles.map(facet).join("")}endsolid part\n`;
}

/** The sides and both ends of a prism with a convex, counterclockwise base, moved by `along`. */
function prism(base: number[][], along: number[]): number[][][] {
    const top = base.map((corner) => corner.map((value, axis) => value + (along[axis] ?? 0)));
    const at = (ring: number[][], index: number) => ring[index % ring.length] ?? [];
    const sides = base.flatMap((_, i) => [
        [at(base, i), at(base, i + 1), at(top, i + 1)],
        [at(base, i), at(top, i + 1), at(top, i)],
    ]);
    const ends = base.slice(2).flatMap((_, i) => [
        [at(base, 0), at(base, i + 2), at(base, i + 1)],
        [at(top, 0), at(top, i + 1), at(top, i + 2)],
    ]);
    return [...sides, ...ends];
}

/** An angle bracket with a rib and two round bosses, z up. */
export function bracketStl(): string {
    const plate = (width: number, depth: number, z: number) => [
        [0, 0, z],
        [width, 0, z],
        [width, depth, z],
        [0, depth, z],
    ];
    const rib = [
        [0.1, 0.36, 0.1],
        [0.6, 0.36, 0.1],
        [0.1, 0.36, 0.6],
    ];
    const circle = (x: number, y: number) =>
        Array.from({ length: 48 }, (_, i) => (2 * Math.PI * i) / 48).map((angle) => [
            x + 0.12 * Math.cos(angle),
            y + 0.12 * Math.sin(angle),
            0.1,
        ]);
    return stl([
        ...prism(plate(1.2, 0.8, 0), [0, 0, 0.1]),
        ...prism(plate(0.1, 0.8, 0.1), [0, 0, 0.8]),
        ...prism(rib, [0, 0.08, 0]),
        ...prism(circle(0.85, 0.2), [0, 0, 0.2]),
        ...prism(circle(0.85, 0.6), [0, 0, 0.2]),
    ]);
}

/** A NumPy array of float64. `isVector` drops the second axis, whose length is 1. */
function npy(rows: number[][], isVector = false): Buffer {
    const shape = isVector ? `${rows.length},` : `${rows.length}, ${rows[0]?.length ?? 0}`;
    const header = `{'descr': '<f8', 'fortran_order': False, 'shape': (${shape}), }`;
    // The data begins at a multiple of 64 bytes.
    const padded = `${header.padEnd(64 * Math.ceil((11 + header.length) / 64) - 11)}\n`;
    const length = Buffer.alloc(2);
    length.writeUInt16LE(padded.length);
    const magic = Buffer.from("\x93NUMPY\x01\x00", "latin1");
    return Buffer.concat([magic, length, Buffer.from(padded), Buffer.from(new Float64Array(rows.flat()).buffer)]);
}

/** A ZIP archive of uncompressed files. */
function zip(files: Record<string, Buffer>): Buffer {
    const [entries, directory]: [Buffer[], Buffer[]] = [[], []];
    let offset = 0;
    for (const [name, content] of Object.entries(files)) {
        // Version 2.0, no flags, stored, 1980-01-01, checksum, both sizes, and the length of the name.
        const common = Buffer.alloc(26);
        common.writeUInt16LE(20, 0);
        common.writeUInt16LE(0x21, 8);
        common.writeUInt32LE(crc32(content), 10);
        common.writeUInt32LE(content.length, 14);
        common.writeUInt32LE(content.length, 18);
        common.writeUInt16LE(name.length, 22);
        const entry = Buffer.concat([Buffer.from("PK\x03\x04"), common, Buffer.from(name), content]);
        const tail = Buffer.alloc(14);
        tail.writeUInt32LE(offset, 10);
        directory.push(Buffer.concat([Buffer.from("PK\x01\x02\x14\x00"), common, tail, Buffer.from(name)]));
        entries.push(entry);
        offset += entry.length;
    }
    const size = directory.reduce((sum, part) => sum + part.length, 0);
    const end = Buffer.alloc(18);
    end.writeUInt16LE(directory.length, 4);
    end.writeUInt16LE(directory.length, 6);
    end.writeUInt32LE(size, 8);
    end.writeUInt32LE(offset, 12);
    return Buffer.concat([...entries, ...directory, Buffer.from("PK\x05\x06"), end]);
}

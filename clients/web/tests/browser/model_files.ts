/** Model files that tests of `modalcast view` write: a beam as a NumPy archive or an STL file. */

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
        const facet = (face: number[]) =>
            `facet normal 0 0 0\nouter loop\n${face
                .map((vertex) => `vertex ${vertices[vertex]?.join(" ")}\n`)
                .join("")}endloop\nendfacet\n`;
        return `solid beam\n${this.faces.map(facet).join("")}endsolid beam\n`;
    }
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

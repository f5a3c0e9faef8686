/** Views that fit a box into an image. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { FIELD_OF_VIEW, fitBox, fitPicture, type ImageArea, type View } from "../src/render/framing";
import { normalized } from "../src/render/lighting";
import { cross, dot, norm, subtract, type Vec3 } from "../src/scene/affine";

const DESKTOP: ImageArea = { width: 964, height: 800, coveredTop: 54, coveredBottom: 52 };
const PHONE: ImageArea = { width: 390, height: 844, coveredTop: 54, coveredBottom: 110 };
/** A long and a tall box; z is up. */
const BEAM = [-1, -0.1, -0.1, 3, 0.1, 0.1];
const TOWER = [0, 0, 0, 0.2, 0.2, 5];
const UP: Vec3 = [0, 0, 1];
const TO_CAMERA = normalized([0.42, -0.9, 0.14]);
const SLOPE = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);

/** Pixels of a point, from the top left corner. */
function project({ eye, target }: View, point: Vec3, { width, height }: ImageArea): [number, number] {
    const toCamera = normalized(subtract(eye, target));
    const right = normalized(cross(UP, toCamera));
    const offset = subtract(point, eye);
    const scale = height / 2 / (SLOPE * -dot(offset, toCamera));
    return [width / 2 + scale * dot(offset, right), height / 2 - scale * dot(offset, cross(toCamera, right))];
}

/** Smallest and largest x and y of the corners of a box in pixels. */
function extent(view: View, bounds: number[], area: ImageArea) {
    const corners = Array.from({ length: 8 }, (_, corner) =>
        project(view, [0, 1, 2].map((axis) => bounds[axis + ((corner >> axis) & 1) * 3]) as Vec3, area),
    );
    const [x, y] = [corners.map((pixel) => pixel[0]), corners.map((pixel) => pixel[1])];
    return { left: Math.min(...x), right: Math.max(...x), top: Math.min(...y), bottom: Math.max(...y) };
}

for (const [name, bounds] of [
    ["beam", BEAM],
    ["tower", TOWER],
] as const) {
    for (const [device, area] of [
        ["desktop", DESKTOP],
        ["phone", PHONE],
    ] as const) {
        test(`a ${name} fills the free area of a ${device}`, () => {
            const view = fitBox(bounds, TO_CAMERA, UP, area);
            const { left, right, top, bottom } = extent(view, [...bounds], area);
            const freeHeight = area.height - area.coveredTop - area.coveredBottom;
            assert.ok(left >= 0 && right <= area.width, `x from ${left} to ${right}`);
            assert.ok(top >= area.coveredTop && bottom <= area.height - area.coveredBottom, `y ${top} to ${bottom}`);
            // In one direction at least, it is as large as it can be. Perspective makes the nearer half larger.
            const fill = Math.max((right - left) / area.width, (bottom - top) / freeHeight);
            assert.ok(fill > 0.85 && fill <= 0.95, `expected a fill of about 0.94, got ${fill}`);
            // The center of the box is at the center of the free area.
            const center = [0, 1, 2].map((axis) => ((bounds[axis] ?? 0) + (bounds[axis + 3] ?? 0)) / 2) as Vec3;
            const [x, y] = project(view, center, area);
            assert.ok(Math.abs(x - area.width / 2) < 1e-6);
            assert.ok(Math.abs(y - (area.coveredTop + freeHeight / 2)) < 1e-6);
        });
    }
}

test("elements that cover the whole image leave a third of it", () => {
    const covered = { ...PHONE, coveredTop: 400, coveredBottom: 600 };
    const { top, bottom } = extent(fitBox(TOWER, TO_CAMERA, UP, covered), TOWER, covered);
    assert.ok(bottom - top > 0.25 * covered.height, `expected a visible tower, got ${bottom - top} pixels`);
});

test("a box of one point is viewed from a distance of 1", () => {
    const { eye, target } = fitBox([1, 2, 3, 1, 2, 3], TO_CAMERA, UP, { ...PHONE, coveredTop: 0, coveredBottom: 0 });
    assert.deepEqual(target, [1, 2, 3]);
    assert.ok(Math.abs(norm(subtract(eye, target)) - 1) < 1e-12);
});

test("a picture of the whole box becomes a view of the whole box", () => {
    const wide = { width: 1280, height: 720, coveredTop: 0, coveredBottom: 0 };
    const picture = { ...fitBox(BEAM, TO_CAMERA, UP, wide), fieldOfView: FIELD_OF_VIEW, aspect: 16 / 9 };
    // On the phone, the same camera crops both ends.
    const cropped = extent(picture, BEAM, PHONE);
    assert.ok(cropped.left < 0 && cropped.right > PHONE.width, "control");
    const [view, expected] = [fitPicture(picture, BEAM, UP, PHONE), fitBox(BEAM, TO_CAMERA, UP, PHONE)];
    assert.ok(norm(subtract(view.eye, expected.eye)) < 1e-9 && norm(subtract(view.target, expected.target)) < 1e-9);
});

test("a picture of a part keeps this part in view", () => {
    const target: Vec3 = [2, 0, 0];
    const eye = target.map((value, axis) => value + 1.5 * (TO_CAMERA[axis] ?? 0)) as Vec3;
    const picture = { eye, target, fieldOfView: 40, aspect: 16 / 9 };
    const view = fitPicture(picture, BEAM, UP, PHONE);
    // The picture is as wide as the image, and its center is that of the free area.
    const right = normalized(cross(UP, TO_CAMERA));
    const halfWidth = 1.5 * Math.tan((40 * Math.PI) / 360) * (16 / 9);
    const end = target.map((value, axis) => value + halfWidth * (right[axis] ?? 0)) as Vec3;
    assert.ok(Math.abs(project(view, end, PHONE)[0] - PHONE.width) < 1e-6);
    assert.ok(Math.abs(project(view, target, PHONE)[1] - (54 + (844 - 54 - 110) / 2)) < 1e-6);
});

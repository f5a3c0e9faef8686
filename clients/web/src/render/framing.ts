/** Fits a box into the free area of the image, which other elements of the page do not cover. */

import { addScaled, cross, dot, norm, subtract, type Vec3 } from "../scene/affine";
import { at } from "../scene/numbers";
import { normalized } from "./lighting";

/** Vertical field of view in degrees, and fraction of the free area that a framed box fills, as on the server. */
export const FIELD_OF_VIEW = 28;
const IMAGE_FILL = 0.94;
/** Fraction of the height that is treated as free even if more is covered. */
const SMALLEST_FREE_HEIGHT = 0.3;

/** Size of an image, and the heights that are covered at its top and bottom, in pixels. */
export interface ImageArea {
    width: number;
    height: number;
    coveredTop: number;
    coveredBottom: number;
}

/** Positions of a camera and of the point that it looks at. */
export interface View {
    eye: Vec3;
    target: Vec3;
}

/** The camera of a picture, with its vertical field of view in degrees and its aspect ratio (width by height). */
export interface PictureCamera extends View {
    fieldOfView: number;
    aspect: number;
}

/** An axis of the image: the direction in the world, and the free range along it at distance 1 from the camera. */
interface ImageAxis {
    direction: Vec3;
    center: number;
    halfExtent: number;
}

/**
 * The closest view from a direction with the whole box in the free area of the image. The center of the box is at the
 * center of the free area, so camera and target are moved parallel to the image.
 *
 * @param bounds min x, y, z, max x, y, z.
 * @param toCamera Unit vector from the box to the camera; not parallel to `up`.
 */
export function fitBox(bounds: ArrayLike<number>, toCamera: Vec3, up: Vec3, area: ImageArea): View {
    const axes = imageAxes(toCamera, up, area);
    const center = [0, 1, 2].map((axis) => (at(bounds, axis) + at(bounds, 3 + axis)) / 2) as Vec3;
    let distance = 0;
    for (let corner = 0; corner < 8; corner++) {
        const offset = subtract(boxCorner(bounds, corner), center);
        const depth = dot(offset, toCamera);
        for (const { direction, center, halfExtent } of axes) {
            // |offset + center depth| <= halfExtent (distance - depth) along the axis.
            const extent = Math.abs(dot(offset, direction) + center * depth) / (IMAGE_FILL * halfExtent);
            distance = Math.max(distance, depth + extent);
        }
    }
    if (!(distance > 0)) distance = 1;
    const target = axes.reduce<Vec3>(
        (point, { direction, center }) => addScaled(point, direction, -center * distance),
        center,
    );
    return { eye: addScaled(target, toCamera, distance), target };
}

function imageAxes(
    toCamera: Vec3,
    up: Vec3,
    { width, height, coveredTop, coveredBottom }: ImageArea,
): [ImageAxis, ImageAxis] {
    const right = normalized(cross(up, toCamera));
    const slope = slopeOf(FIELD_OF_VIEW);
    const covered = (coveredTop + coveredBottom) / height;
    const factor = covered > 0 ? Math.min(1, (1 - SMALLEST_FREE_HEIGHT) / covered) : 1;
    return [
        { direction: right, center: 0, halfExtent: (slope * width) / height },
        {
            direction: cross(toCamera, right),
            center: (slope * factor * (coveredBottom - coveredTop)) / height,
            halfExtent: slope * (1 - factor * covered),
        },
    ];
}

/**
 * The view of a picture, adapted to another aspect ratio. The direction is the same. If the picture shows the whole
 * box, the view fits the box. Otherwise, it shows at least what the picture shows around its target.
 */
export function fitPicture(picture: PictureCamera, bounds: ArrayLike<number>, up: Vec3, area: ImageArea): View {
    const { eye, target, fieldOfView, aspect } = picture;
    const offset = subtract(eye, target);
    const toCamera = normalized(offset);
    if (showsBox(picture, bounds, up)) return fitBox(bounds, toCamera, up, area);
    const slope = slopeOf(fieldOfView);
    const [x, y] = imageAxes(toCamera, up, area);
    const distance = norm(offset) * Math.max((slope * aspect) / x.halfExtent, slope / y.halfExtent);
    const moved = addScaled(target, y.direction, -y.center * distance);
    return { eye: addScaled(moved, toCamera, distance), target: moved };
}

function showsBox({ eye, target, fieldOfView, aspect }: PictureCamera, bounds: ArrayLike<number>, up: Vec3): boolean {
    const toCamera = normalized(subtract(eye, target));
    const right = normalized(cross(up, toCamera));
    const imageUp = cross(toCamera, right);
    const slope = slopeOf(fieldOfView);
    return Array.from({ length: 8 }, (_, corner) => subtract(boxCorner(bounds, corner), eye)).every((offset) => {
        const depth = -dot(offset, toCamera);
        const isInside = Math.abs(dot(offset, imageUp)) <= slope * depth;
        return isInside && Math.abs(dot(offset, right)) <= slope * aspect * depth;
    });
}

/** Half of the height of the image at distance 1 from the camera. */
function slopeOf(fieldOfView: number): number {
    return Math.tan((fieldOfView / 2) * (Math.PI / 180));
}

/** A corner of a box, by a number from 0 to 7. */
function boxCorner(bounds: ArrayLike<number>, corner: number): Vec3 {
    return [0, 1, 2].map((axis) => at(bounds, axis + ((corner >> axis) & 1) * 3)) as Vec3;
}

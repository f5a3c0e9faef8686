/** The camera: framing, messages of the contract, and the expression that Python users paste. */

import type { MessageInitShape } from "@bufbuild/protobuf";
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { CameraSchema } from "../proto/modalcast/v1/frames_pb";
import { addScaled, dot, norm, subtract, type Vec3 } from "../scene/affine";
import type { SceneDescription } from "../scene/description";
import { FIELD_OF_VIEW, fitBox, fitPicture, type ImageArea, type PictureCamera } from "./framing";
import { fromYUp, lightingOf, normalized, unitVector, upAxis } from "./lighting";

/** Tangent of the angle between the up axis and the direction of a view from above or below. */
const TOP_VIEW_TILT = 1e-4;

export type CameraMessage = MessageInitShape<typeof CameraSchema>;

export class OrbitCamera {
    readonly camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.1, 10);
    private controls: OrbitControls | null = null;
    private scene: SceneDescription | null = null;
    private recordedView: PictureCamera | null = null;
    /** The direction of the last framing; null for the default. */
    private framedFrom: Vec3 | null = null;
    /** Whether the camera has moved since it framed the scene. */
    hasMoved = false;
    /** Heights in pixels that other elements cover at the top and bottom of the element. */
    coveredHeights: () => Pick<ImageArea, "coveredTop" | "coveredBottom"> = () => ({ coveredTop: 0, coveredBottom: 0 });
    onChange: () => void = () => {};

    constructor(private readonly element: HTMLElement) {}

    /** Frames a scene. The controls are created anew, because they read the up axis only once. */
    setScene(scene: SceneDescription): void {
        this.scene = scene;
        this.recordedView = null;
        this.controls?.dispose();
        this.camera.up.set(...unitVector(upAxis(scene)));
        const controls = new OrbitControls(this.camera, this.element);
        controls.zoomToCursor = true;
        controls.enableDamping = false;
        controls.addEventListener("change", () => {
            this.hasMoved = true;
            this.onChange();
        });
        this.controls = controls;
        this.frame();
    }

    /** Length of a pixel of the element at the distance of the target, in scene units. */
    get unitsPerPixel(): number {
        const { clientHeight } = this.element;
        const slope = Math.tan((this.camera.fov / 2) * (Math.PI / 180));
        return (2 * slope * norm(subtract(this.eye, this.target))) / Math.max(1, clientHeight);
    }

    /** A world direction in view axes: right, up, and towards the viewer. */
    directionInView(direction: Vec3): Vec3 {
        this.camera.updateMatrixWorld();
        return new THREE.Vector3(...direction).transformDirection(this.camera.matrixWorldInverse).toArray() as Vec3;
    }

    get target(): Vec3 {
        return this.controls ? (this.controls.target.toArray() as Vec3) : [0, 0, 0];
    }

    get eye(): Vec3 {
        return this.camera.position.toArray() as Vec3;
    }

    set enabled(isEnabled: boolean) {
        if (this.controls) this.controls.enabled = isEnabled;
    }

    /**
     * Views the rest bounds. Without a direction, it uses the direction of the recorded view or, without one, that of
     * the server's default camera. The view adapts to the size of the element until the camera moves.
     *
     * @param toCamera Unit vector from the scene to the camera.
     */
    frame(toCamera: Vec3 | null = null): void {
        if (!this.scene) return;
        const axis = upAxis(this.scene);
        const { bounds } = this.scene.info;
        const { recordedView } = this;
        this.framedFrom = toCamera;
        const direction = toCamera ?? normalized(lightingOf(this.scene).toCamera);
        const { eye, target } =
            recordedView && !toCamera
                ? fitPicture(recordedView, bounds, unitVector(axis), this.imageArea)
                : fitBox(bounds, direction, unitVector(axis), this.imageArea);
        this.look(eye, target);
        this.hasMoved = false;
    }

    /** Frames the scene as the recorded view does. */
    frameAs(view: PictureCamera): void {
        this.recordedView = view;
        this.frame();
    }

    /**
     * Views the scene along an axis of the world. If the camera has not moved since it framed the scene, it frames the
     * scene again. Otherwise, it keeps its target and distance.
     */
    lookAlong(toCamera: Vec3): void {
        if (!this.scene) return;
        const axis = upAxis(this.scene);
        const isUp = toCamera[axis] !== 0;
        // The up direction of a view from above or below is y or, if y is up, -z.
        const tilt = fromYUp([0, 0, isUp ? TOP_VIEW_TILT : 0], axis);
        const direction = normalized(addScaled(toCamera, tilt, 1));
        if (!this.hasMoved) return this.frame(direction);
        const distance = norm(subtract(this.eye, this.target));
        this.look(addScaled(this.target, direction, distance), this.target);
    }

    look(eye: Vec3, target: Vec3): void {
        if (!this.controls) return;
        this.camera.position.set(...eye);
        this.controls.target.set(...target);
        const distance = this.camera.position.distanceTo(this.controls.target);
        this.controls.minDistance = 1e-4 * distance;
        this.controls.maxDistance = 1e3 * distance;
        this.controls.update();
        this.hasMoved = true;
        this.onChange();
    }

    /** Adapts to the size of the element. */
    resize(): void {
        const { width, height } = this.imageArea;
        this.camera.aspect = width / height;
        this.camera.updateProjectionMatrix();
        if (!this.hasMoved) this.frame(this.framedFrom);
    }

    private get imageArea(): ImageArea {
        const { clientWidth, clientHeight } = this.element;
        return { width: Math.max(1, clientWidth), height: Math.max(1, clientHeight), ...this.coveredHeights() };
    }

    toMessage(): CameraMessage {
        const up = this.camera.up.toArray();
        return {
            view: { case: "lookAt", value: { eye: this.eye, target: this.target, up } },
            lens: { case: "fieldOfView", value: this.camera.fov },
        };
    }

    /** The expression that creates this camera in the Python package, for `import modalcast as mc`. */
    toPython(): string {
        const tuple = (vector: Vec3) =>
            `(${vector.map((value) => Number(value.toPrecision(7)).toString()).join(", ")})`;
        return `mc.look_at(eye=${tuple(this.eye)}, target=${tuple(this.target)}, field_of_view=${this.camera.fov})`;
    }

    /** Projects a point to pixels of the element; null if the point is behind the camera. */
    project(point: Vec3): [number, number] | null {
        this.camera.updateMatrixWorld();
        const place = new THREE.Vector3(...point).applyMatrix4(this.camera.matrixWorldInverse);
        if (place.z >= 0) return null;
        place.applyMatrix4(this.camera.projectionMatrix);
        const { clientWidth, clientHeight } = this.element;
        return [((place.x + 1) / 2) * clientWidth, ((1 - place.y) / 2) * clientHeight];
    }

    /** The point under a pixel in the plane through `point` that is parallel to the image. */
    unproject(x: number, y: number, point: Vec3): Vec3 {
        this.camera.updateMatrixWorld();
        const { clientWidth, clientHeight } = this.element;
        const ray = new THREE.Vector3((2 * x) / clientWidth - 1, 1 - (2 * y) / clientHeight, 0.5).unproject(
            this.camera,
        );
        const direction = normalized(subtract(ray.toArray() as Vec3, this.eye));
        const axis = this.camera.getWorldDirection(new THREE.Vector3()).toArray() as Vec3;
        const depth = dot(subtract(point, this.eye), axis);
        return addScaled(this.eye, direction, depth / dot(direction, axis));
    }
}

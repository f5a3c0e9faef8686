/** A recording of a beam that swings, written without a server. */

import { create } from "@bufbuild/protobuf";
import {
    DomainDescriptionSchema,
    MaterialDescriptionSchema,
    SceneInfoSchema,
    ShapeDescriptionSchema,
} from "../../src/proto/modalcast/v1/scenes_pb";
import { StateContent } from "../../src/proto/modalcast/v1/states_pb";
import { cross, norm, subtract, type Vec3 } from "../../src/scene/affine";
import { ArrayKind, type SceneDescription } from "../../src/scene/description";
import { Contents, sceneMessages, stateMessage, writeRecording } from "../recording_file";
import { floats } from "../scene";
import { Beam } from "./model_files";

/** Number of states, which are 50 ms apart. */
const STATES = 41;
/** Largest displacement of the free end, for a beam of length 1. */
const AMPLITUDE = 0.05;

/** The beam lies along z, with y up, so that it is as wide as the picture of a desktop. */
function beamScene(): { scene: SceneDescription; contents: Contents } {
    const beam = new Beam();
    const { vertices, faces } = beam;
    const corners = faces.flat();
    const normals = faces.flatMap((face) => {
        const [a, b, c] = face.map((vertex) => vertices[vertex] as Vec3) as [Vec3, Vec3, Vec3];
        const normal = cross(subtract(b, a), subtract(c, a));
        return [0, 1, 2].flatMap(() => normal.map((value) => value / norm(normal)));
    });
    const numbers = (values: number[]) => new Uint8Array(new Uint32Array(values).buffer);
    const contents = new Contents();
    const arrays = contents.add([
        [ArrayKind.INDICES, numbers(corners.map((_, index) => index))],
        [ArrayKind.CORNER_VERTICES, numbers(corners)],
        [ArrayKind.REST_POSITIONS, floats(...vertices.flat())],
        [ArrayKind.REST_NORMALS, floats(...normals)],
        [ArrayKind.MODES, floats(...beam.modes.flat())],
    ]);
    const [rank, triangles] = [2, faces.length];
    const sizes = { vertices: vertices.length, corners: corners.length, triangles, rank };
    const bounds = [-0.06, -0.06, 0, 0.06, 0.06, 1];
    const gray = { ambient: [0.6, 0.6, 0.6], diffuse: [0.6, 0.6, 0.6], specular: [0, 0, 0], alpha: 1 };
    return {
        contents,
        scene: {
            info: create(SceneInfoSchema, { scene: "beam", unit: 1, up: "y", bounds, domains: 1, coordinates: 2n }),
            shapes: [create(ShapeDescriptionSchema, { shape: 0, ...sizes, arrays })],
            materials: [create(MaterialDescriptionSchema, { material: 0, ...gray })],
            textures: [],
            domains: [create(DomainDescriptionSchema, { domain: 0, name: "beam", shape: 0 })],
        },
    };
}

/** Two seconds at 20 states per second. Its view is that of a picture of 1280 x 720 pixels that shows the whole beam. */
export function beamRecording(): Promise<Uint8Array> {
    const { scene, contents } = beamScene();
    const states = Array.from({ length: STATES }, (_, number) => {
        const time = number / 20;
        const q = floats(AMPLITUDE * Math.sin(Math.PI * time), 0);
        return stateMessage(number, time, [[StateContent.Q, q]], true);
    });
    return writeRecording([...sceneMessages(scene, contents), ...states], {
        recording: { version: "1", contents: "embedded" },
        content: { sha256: contents.sha256 },
        view: { eye: "1.9 0.5 0.5", target: "0 0 0.5", field_of_view: "28", width: "1280", height: "720" },
    });
}

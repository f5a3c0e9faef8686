/** Pictures that the browser and the server draw: RGBA values of 0 to 255, top row first. */

import type { Page } from "playwright-core";
import { Format, FrameService } from "../../src/proto/modalcast/v1/frames_pb";
import type { CameraMessage } from "../../src/render/camera";
import type { Server } from "../../src/source/server";

/** The camera of a page. */
export function cameraOf(page: Page): Promise<CameraMessage> {
    return page.evaluate(() => modalcastViewer.viewport.camera.toMessage());
}

/** What the server draws. */
export async function serverPicture(
    server: Server,
    scene: string,
    camera: CameraMessage,
    [width, height]: readonly [number, number],
): Promise<Uint8Array> {
    // Streams of this size have one sample per pixel on a CPU, single frames have four by default.
    const request = { scene, pictures: [{ width, height, camera, format: Format.RGBA, samples: 1 }] };
    const bytes = new Uint8Array(4 * width * height);
    for await (const { part } of server.channel.serverStream(FrameService.method.renderFrame, request)) {
        if (part.case === "chunk") bytes.set(part.value.data, Number(part.value.offset));
    }
    return bytes;
}

/** What the browser draws. */
export async function browserPicture(page: Page): Promise<Uint8Array> {
    const [width, rows] = await page.evaluate(
        () =>
            new Promise<[number, number[]]>((done) => {
                const { viewport } = modalcastViewer;
                const gl = viewport.gl?.getContext() as WebGL2RenderingContext;
                const [columns, height] = viewport.pixelSize;
                viewport.onDrawn = () => {
                    viewport.onDrawn = () => {};
                    const pixels = new Uint8Array(4 * columns * height);
                    gl.readPixels(0, 0, columns, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
                    done([columns, Array.from(pixels)]);
                };
                viewport.invalidate();
            }),
    );
    // WebGL reads the bottom row first.
    const picture = new Uint8Array(rows.length);
    const rowBytes = 4 * width;
    for (let begin = 0; begin < rows.length; begin += rowBytes)
        picture.set(rows.slice(begin, begin + rowBytes), rows.length - rowBytes - begin);
    return picture;
}

/** Mean of the differences of values. */
export function meanDifference(a: ArrayLike<number>, b: ArrayLike<number>): number {
    let sum = 0;
    for (let index = 0; index < a.length; index++) sum += Math.abs((a[index] ?? 0) - (b[index] ?? 0));
    return sum / a.length;
}

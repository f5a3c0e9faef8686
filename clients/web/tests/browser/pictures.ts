/** Pictures that the browser and the server draw: RGBA values of 0 to 255, or domains, top row first. */

import type { MessageInitShape } from "@bufbuild/protobuf";
import type { Page } from "playwright-core";
import { Format, FrameService, Output, type PictureSchema } from "../../src/proto/modalcast/v1/frames_pb";
import type { CameraMessage } from "../../src/render/camera";
import type { Server } from "../../src/source/server";

/** In a picture of domains: no surface. */
export const NO_DOMAIN = 0xffffffff;

/** The camera of a page. */
export function cameraOf(page: Page): Promise<CameraMessage> {
    return page.evaluate(() => modalcastViewer.viewport.camera.toMessage());
}

/** What the server draws. `camera`: undefined for the server's default camera. */
export async function serverPicture(
    server: Server,
    scene: string,
    camera: CameraMessage | undefined,
    [width, height]: readonly [number, number],
    samples = 1,
): Promise<Uint8Array> {
    // Streams of this size have one sample per pixel on a CPU, single frames have four by default.
    return renderFrame(server, scene, { width, height, format: Format.RGBA, samples, ...(camera && { camera }) });
}

/** The domain at each pixel, drawn by the server. */
export async function serverDomains(
    server: Server,
    scene: string,
    camera: CameraMessage,
    [width, height]: readonly [number, number],
): Promise<Uint32Array> {
    const bytes = await renderFrame(server, scene, { width, height, camera, output: Output.DOMAINS });
    return new Uint32Array(bytes.buffer);
}

type Picture = MessageInitShape<typeof PictureSchema> & { width: number; height: number };

async function renderFrame(server: Server, scene: string, picture: Picture): Promise<Uint8Array> {
    const request = { scene, pictures: [picture] };
    const bytes = new Uint8Array(4 * picture.width * picture.height);
    for await (const { part } of server.channel.serverStream(FrameService.method.renderFrame, request)) {
        if (part.case === "chunk") bytes.set(part.value.data, Number(part.value.offset));
    }
    return bytes;
}

/** The domain at each pixel, drawn by the browser. */
export async function drawnDomains(page: Page, size: readonly [number, number]): Promise<number[]> {
    return page.evaluate(([width, height]) => {
        const { renderer, viewport } = modalcastViewer;
        return Array.from(renderer?.domainIds(viewport.camera.camera, width, height) ?? []);
    }, size);
}

/** Intersection over union: pixels with the same domain among those where either picture has a domain. */
export function iou(a: ArrayLike<number>, b: ArrayLike<number>): number {
    let both = 0;
    let either = 0;
    for (let pixel = 0; pixel < a.length; pixel++) {
        if (a[pixel] === NO_DOMAIN && b[pixel] === NO_DOMAIN) continue;
        either++;
        if (a[pixel] === b[pixel]) both++;
    }
    return both / either;
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

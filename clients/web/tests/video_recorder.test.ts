/** Formats of videos. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { bitRate, supportedType, VideoRecorder } from "../src/control/video_recorder";

test("a video is MP4 where the browser can record it, else WebM", () => {
    assert.equal(supportedType(() => true)?.mimeType, "video/mp4;codecs=avc1.640033");
    assert.equal(supportedType((type) => type.startsWith("video/webm"))?.extension, "webm");
    assert.equal(supportedType((type) => type === "video/webm")?.mimeType, "video/webm");
    assert.equal(
        supportedType(() => false),
        null,
    );
});

test("the bit rate grows with the number of pixels up to a limit", () => {
    assert.equal(bitRate(1280, 720), 4_147_200);
    assert.equal(bitRate(7680, 4320), 25e6);
});

test("a browser without a recorder says so", () => {
    assert.throws(() => new VideoRecorder({} as HTMLCanvasElement), /This browser cannot record videos/);
});

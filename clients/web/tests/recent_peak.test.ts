import assert from "node:assert/strict";
import { test } from "node:test";
import { RecentPeak } from "../src/scene/recent_peak";

test("the peak of a vibration is its amplitude, and decays with it", () => {
    const peak = new RecentPeak();
    const peaks = Array.from({ length: 200 }, (_, frame) =>
        peak.add(frame < 100 ? Math.abs(Math.sin(0.7 * frame)) : 0.1, 50 * frame),
    );
    assert.ok(peaks.slice(20, 100).every((value) => value > 0.95 && value <= 1));
    assert.equal(peaks.at(-1), 0.1);
    // It is held for at least one window of 1.5 s.
    assert.ok((peaks[125] ?? 0) > 0.95);
    // A pause forgets it.
    const paused = new RecentPeak();
    paused.add(3, 0);
    assert.equal(paused.add(1, 9000), 1);
});

/** Samples the resources of a page and of its server, and finds those that grow. */

import { readdirSync, readFileSync } from "node:fs";
import type { CDPSession, Page } from "playwright-core";

/** Resources of the page after a garbage collection, and of the server. */
export interface Resources {
    /** Bytes of JavaScript objects. */
    heap: number;
    /** Bytes of array buffers outside of the heap. */
    buffers: number;
    nodes: number;
    listeners: number;
    geometries: number;
    textures: number;
    shaderPrograms: number;
    /** Bytes of the server's resident memory. */
    serverMemory: number;
    serverDescriptors: number;
}

/** Largest growth over a whole test that counts as noise. Counts of objects must not grow at all. */
export const NOISE: Resources = {
    heap: 1.5e6,
    buffers: 2e6,
    nodes: 20,
    listeners: 4,
    geometries: 0,
    textures: 0,
    shaderPrograms: 0,
    serverMemory: 12e6,
    serverDescriptors: 0,
};

/** Reads the resources of one page and of one server process. */
export class ResourceMeter {
    private constructor(
        private readonly session: CDPSession,
        private readonly page: Page,
    ) {}

    static async create(page: Page): Promise<ResourceMeter> {
        const session = await page.context().newCDPSession(page);
        await session.send("Performance.enable");
        await session.send("HeapProfiler.enable");
        return new ResourceMeter(session, page);
    }

    async read(serverPid: number): Promise<Resources> {
        await this.session.send("HeapProfiler.collectGarbage");
        const { metrics } = await this.session.send("Performance.getMetrics");
        const metric = (name: string) => metrics.find((candidate) => candidate.name === name)?.value ?? Number.NaN;
        const usage = (await this.session.send("Runtime.getHeapUsage")) as unknown as Record<string, number>;
        const gpu = await this.page.evaluate(() => {
            const info = modalcastViewer.viewport.gl?.info;
            return { ...info?.memory, shaderPrograms: info?.programs?.length ?? 0 };
        });
        return {
            heap: usage["usedSize"] ?? Number.NaN,
            buffers: usage["backingStorageSize"] ?? Number.NaN,
            nodes: metric("Nodes"),
            listeners: metric("JSEventListeners"),
            geometries: gpu.geometries ?? Number.NaN,
            textures: gpu.textures ?? Number.NaN,
            shaderPrograms: gpu.shaderPrograms,
            serverMemory: residentBytes(serverPid),
            serverDescriptors: readdirSync(`/proc/${serverPid}/fd`).length,
        };
    }
}

function residentBytes(pid: number): number {
    const found = /^VmRSS:\s+(\d+) kB$/m.exec(readFileSync(`/proc/${pid}/status`, "utf8"));
    return 1024 * Number(found?.[1]);
}

/**
 * Growth of each resource over all samples: the median slope of all pairs (Theil-Sen), times the number of intervals.
 * A single large sample does not change it.
 */
export function growth(samples: readonly Resources[]): Resources {
    const names = Object.keys(NOISE) as (keyof Resources)[];
    return Object.fromEntries(
        names.map((name) => {
            const values = samples.map((sample) => sample[name]);
            return [name, medianSlope(values) * (values.length - 1)];
        }),
    ) as unknown as Resources;
}

/** The resources that have grown by more than the noise. */
export function growing(samples: readonly Resources[]): (keyof Resources)[] {
    const total = growth(samples);
    // Not `>`: a value that is not a number counts as growth.
    return (Object.keys(NOISE) as (keyof Resources)[]).filter((name) => !(total[name] <= NOISE[name]));
}

function medianSlope(values: readonly number[]): number {
    const slopes: number[] = [];
    for (let i = 0; i < values.length; i++) {
        for (let j = i + 1; j < values.length; j++) slopes.push(((values[j] ?? 0) - (values[i] ?? 0)) / (j - i));
    }
    slopes.sort((a, b) => a - b);
    return slopes[slopes.length >> 1] ?? 0;
}

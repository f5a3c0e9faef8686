// Bundles the browser tests and runs them with Node's test runner, one after the other.
// MODALCAST_PROGRAMS: folder with `modalcast` and `modalcast-sim` (default target/debug). MODALCAST_CHROMIUM: the browser.
// Arguments are passed to Node, for example --test-name-pattern=pull.
import { spawnSync } from "node:child_process";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const folder = dirname(fileURLToPath(import.meta.url));
const outfile = join(folder, "../../build/browser/smoke.test.mjs");
await build({
    entryPoints: [join(folder, "smoke.test.ts")],
    outfile,
    bundle: true,
    format: "esm",
    platform: "node",
    packages: "external",
    logLevel: "warning",
});
const options = ["--test", "--test-concurrency=1", "--test-reporter=spec", ...process.argv.slice(2)];
process.exit(spawnSync(process.execPath, [...options, outfile], { stdio: "inherit" }).status ?? 1);

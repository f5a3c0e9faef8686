// Bundles the browser tests and runs them with Node's test runner, one after the other. With --long as the first
// argument, it runs those that take minutes (*.long.ts) instead.
// MODALCAST_PROGRAMS: folder with the programs (default target/debug). MODALCAST_CHROMIUM: the browser.
// MODALCAST_COMMITTED_PAGE: if set, servers show the page of dist instead of the one that they were built with.
// MODALCAST_SCREENSHOTS: folder for screenshots of some tests.
// Other arguments are passed to Node, for example --test-name-pattern=pull.
import { spawnSync } from "node:child_process";
import { readdirSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const options = process.argv.slice(2);
const isLong = options[0] === "--long";
const suffix = isLong ? ".long.ts" : ".test.ts";
const folder = dirname(fileURLToPath(import.meta.url));
const outdir = join(folder, "../../build/browser");
const names = readdirSync(folder).filter((name) => name.endsWith(suffix));
await build({
    entryPoints: names.map((name) => join(folder, name)),
    outdir,
    outExtension: { ".js": ".mjs" },
    bundle: true,
    format: "esm",
    platform: "node",
    packages: "external",
    logLevel: "warning",
});
const files = names.map((name) => join(outdir, name.replace(/\.ts$/, ".mjs")));
const all = ["--test", "--test-concurrency=1", "--test-reporter=spec", ...options.slice(isLong ? 1 : 0), ...files];
process.exit(spawnSync(process.execPath, all, { stdio: "inherit" }).status ?? 1);

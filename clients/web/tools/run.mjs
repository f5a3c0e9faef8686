// Bundles and runs a tool of this folder: node tools/run.mjs NAME [ARGUMENTS]. The environment is that of the browser tests.
import { spawnSync } from "node:child_process";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const folder = dirname(fileURLToPath(import.meta.url));
const [name, ...options] = process.argv.slice(2);
const outfile = join(folder, `../build/tools/${name}.mjs`);
await build({
    entryPoints: [join(folder, `${name}.ts`)],
    outfile,
    bundle: true,
    format: "esm",
    platform: "node",
    packages: "external",
    logLevel: "warning",
});
process.exit(spawnSync(process.execPath, [outfile, ...options], { stdio: "inherit" }).status ?? 1);

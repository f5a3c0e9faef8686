// Builds the viewer as one HTML file, compressed: dist/index.html.gz, which the server embeds.
// `--check` compares it with the committed file instead of writing it.
import { execFileSync } from "node:child_process";
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const folder = dirname(fileURLToPath(import.meta.url));
const output = join(folder, "dist/index.html.gz");

execFileSync("npm", ["run", "--silent", "generate"], { cwd: folder, stdio: "inherit" });
const options = {
    bundle: true,
    minify: true,
    write: false,
    target: ["chrome110", "firefox115", "safari16.4"],
    legalComments: "none",
};
const script = await build({ ...options, entryPoints: [join(folder, "src/main.ts")], format: "iife" });
const style = await build({ ...options, entryPoints: [join(folder, "src/style.css")] });

// Functions as replacements, because `$&` in a text would be special.
const html = readFileSync(join(folder, "src/index.html"), "utf8")
    .replace("/*STYLE*/", () => style.outputFiles[0].text.trim())
    .replace("/*SCRIPT*/", () => script.outputFiles[0].text.trim().replaceAll("</script", "<\\/script"));

// gzip without name and time, so that equal sources give equal bytes.
const compressed = execFileSync("gzip", ["-n", "-9", "-c"], { input: html, maxBuffer: 1 << 26 });
if (process.argv.includes("--check")) {
    if (!compressed.equals(readFileSync(output))) {
        console.error("dist/index.html.gz differs from a build of the sources. Build it with: npm run build");
        process.exit(1);
    }
} else {
    mkdirSync(dirname(output), { recursive: true });
    writeFileSync(output, compressed);
}
console.log(
    `dist/index.html.gz: ${(html.length / 1024).toFixed(0)} KiB, ${(compressed.length / 1024).toFixed(0)} KiB compressed`,
);

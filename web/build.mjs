// Builds the view into the Python package; with --check only says whether what lies there is that of the source; with --tests the tests.
import { readdir, readFile, writeFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = fileURLToPath(new URL(".", import.meta.url));
const LARGEST = 100_000;

if (process.argv.includes("--tests")) {
  const entries = (await readdir(`${here}test`)).filter((name) => name.endsWith(".test.ts")).map((name) => `${here}test/${name}`);
  await build({ entryPoints: entries, bundle: true, platform: "node", format: "esm", outdir: `${here}.test`, outExtension: { ".js": ".mjs" } });
} else {
  for (const name of ["replay", "live", "widget"]) {
    const target = `${here}../src/consat/views/${name}.js`;
    const built = await build({
      entryPoints: [`${here}src/${name}.main.ts`], bundle: true, format: name === "replay" ? "iife" : "esm", target: "es2022", minify: true, charset: "utf8", write: false,
      legalComments: "none", banner: { js: "// Built from web/ by `npm run build`; see web/README.md." },
    });
    const text = built.outputFiles[0].text;
    if (text.length > LARGEST) throw new Error(`${name}.js has ${text.length} bytes, but may have at most ${LARGEST}`);
    if (!process.argv.includes("--check")) {
      await writeFile(target, text);
      console.log(`${name}.js written (${text.length.toLocaleString("en")} bytes)`);
    } else if ((await readFile(target, "utf8").catch(() => "")) !== text) {
      console.error(`src/consat/views/${name}.js is not that of web/src; build it with: cd web && npm ci && npm run build`);
      process.exitCode = 1;
    }
  }
}

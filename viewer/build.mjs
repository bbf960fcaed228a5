// Bundles the page: `make viewer`. The result ships in the wheel, but is not in git: it contains three.js.

import { createHash } from "node:crypto";
import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const here = new URL("./", import.meta.url);
const read = (name) => readFileSync(new URL(name, here), "utf8");
const target = new URL("../jaxdrones/visualization/viewer/page.html", here);

const options = { bundle: true, minify: true, write: false, legalComments: "none", charset: "utf8" };
const script = await build({ ...options, entryPoints: [new URL("src/main.js", here).pathname], format: "iife", target: "es2022" });
const style = await build({ ...options, entryPoints: [new URL("src/style.css", here).pathname] });

const hash = createHash("sha256");
for (const name of [...readdirSync(new URL("src/", here)).sort().map((file) => `src/${file}`), "build.mjs", "package.json"]) hash.update(read(name));
const { devDependencies } = JSON.parse(read("package.json"));
const notice = `<!--
Built from viewer/ of jaxdrones by \`make viewer\`; sources sha256 ${hash.digest("hex")}
jaxdrones is under the MIT licence. The script contains three.js ${devDependencies.three}:

${read("node_modules/three/LICENSE").trim()}
-->
`;
const insert = (page, mark, text) => page.split(mark).join(text);
let page = read("src/page.html").replace(/\n\s*/g, "\n");
page = insert(page, "/*STYLE*/", style.outputFiles[0].text.trim());
page = insert(page, "/*SCRIPT*/", script.outputFiles[0].text.trim());
page = page.replace("<!doctype html>\n", () => `<!doctype html>\n${notice}`);
writeFileSync(target, page);
console.log(`${target.pathname}: ${(page.length / 1e6).toFixed(2)} MB`);

// Opens OUT/splat.ply of a fit in other viewers, in Chromium without a window, and takes pictures:
//   npm install && node run.mjs OUT PICTURES [VIEWER...]
// PLY=splat.compressed.ply opens that file of OUT instead.
import { createServer } from "node:http";
import { readFile, mkdir } from "node:fs/promises";
import { extname, join, normalize } from "node:path";
import { fileURLToPath } from "node:url";
import puppeteer from "puppeteer-core";
import { start } from "./view.mjs";

const [out, pictures, ...names] = process.argv.slice(2);
const ply = process.env.PLY ?? "splat.ply";
const here = fileURLToPath(new URL(".", import.meta.url));
const supersplat = join(here, "node_modules/@playcanvas/supersplat-viewer/public");
const kinds = { ".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript", ".css": "text/css",
  ".json": "application/json", ".wasm": "application/wasm" };
const DEGREES = 180 / Math.PI;
const [WIDTH, HEIGHT] = [640, 480];

// SuperSplat turns the PLY by 180 degrees about z, and reads its start camera from settings.json; fov is of the longer side.
const wide = (fov) => 2 * Math.atan((Math.tan(fov / 2) * WIDTH) / HEIGHT) * DEGREES;
const turned = ([x, y, z]) => [-x, -y, z];
const settings = (view) => ({
  version: 2, tonemapping: "none", highPrecisionRendering: false, background: { color: [0, 0, 0] },
  postEffectSettings: { sharpness: { enabled: false, amount: 0 }, bloom: { enabled: false, intensity: 0, blurLevel: 2 },
    grading: { enabled: false, brightness: 1, contrast: 1, saturation: 1, tint: [1, 1, 1] },
    vignette: { enabled: false, intensity: 0, inner: 0, outer: 1, curvature: 1 },
    fringing: { enabled: false, intensity: 0 } },
  animTracks: [], annotations: [], startMode: "default",
  cameras: view ? [{ initial: { position: turned(view.position), target: turned(view.target), fov: wide(view.fov) } }] : [],
});

const server = createServer(async (request, response) => {
  const { pathname } = new URL(request.url, "http://localhost");
  const inside = normalize(pathname).replace(/^(\.\.[/\\])+/, "");
  try {
    let content;
    if (pathname.startsWith("/settings/")) {
      const cameras = JSON.parse(await readFile(join(out, "cameras.json")));
      const how = pathname.slice("/settings/".length);
      content = JSON.stringify(settings(how === "opens" ? null : start(cameras, how)));
    } else if (pathname.startsWith("/data/")) content = await readFile(join(out, inside.slice("/data/".length)));
    else if (pathname.startsWith("/supersplat/")) content = await readFile(join(supersplat, inside.slice("/supersplat/".length)));
    else content = await readFile(join(here, inside));
    response.writeHead(200, { "Content-Type": kinds[extname(pathname)] ?? "application/octet-stream" });
    response.end(content);
  } catch {
    response.writeHead(404).end();
  }
}).listen(0, "127.0.0.1");
await new Promise((done) => server.once("listening", done));
const root = `http://127.0.0.1:${server.address().port}`;

const browser = await puppeteer.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-quic", "--no-first-run"],
});
await mkdir(pictures, { recursive: true });
for (const name of names.length ? names : ["supersplat", "mkkellogg", "spark", "gsplat", "three", "threeGlb"]) {
  for (const how of ["opens", "camera", "bounds"]) {
    const page = await browser.newPage();
    const problems = [];
    page.on("pageerror", (error) => problems.push(String(error)));
    page.on("console", (line) => line.type() === "error" && problems.push(line.text()));
    await page.setViewport({ width: WIDTH, height: HEIGHT });
    const own = name === "supersplat"
      ? `${root}/supersplat/index.html?webgl&noui&noanim&content=/data/${ply}&settings=/settings/${how}`
      : `${root}/viewer.html?viewer=${name.replace("Linear", "&linear")}&how=${how}&ply=${ply}`;
    await page.goto(own, { waitUntil: "load", timeout: 120000 });
    if (name === "supersplat") await new Promise((done) => setTimeout(done, 20000));
    else await page.waitForFunction('document.title === "ready"', { timeout: 120000 }).catch((error) => problems.push(String(error)));
    await page.screenshot({ path: join(pictures, `${name}-${how}.png`) });
    const found = await page.evaluate("document.body.dataset.found ?? ''");
    console.log(name, how, found, problems.slice(0, 3).join(" | ").slice(0, 400));
    await page.close();
  }
}
await browser.close();
server.close();

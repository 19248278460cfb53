"use strict";
// Shows the splat of a fit that is at work, and how far the fit is. The server (kgs/app/live.py) answers when there is
// something new. A page that nobody sees asks for nothing.

const RETRY_MILLISECONDS = 2000;
const MAX_RETRIES = 3;

// What is newer than a version, as { version, text, isOver, splat }; null if nothing came for a while. `splat` is
// absent where it has not changed. The answer is a line of JSON, and the float32 of each column in turn.
async function newerThan(version) {
  const answer = await fetch(`splat?after=${version}`, { cache: "no-store" });
  if (answer.status === 204) return null;
  if (!answer.ok) throw new Error(answer.statusText);
  const bytes = new Uint8Array(await answer.arrayBuffer());
  const end = bytes.indexOf("\n".charCodeAt(0));
  const { layout, ...news } = JSON.parse(new TextDecoder().decode(bytes.subarray(0, end)));
  return layout ? { ...news, splat: plainSplat(layout, bytes.slice(end + 1).buffer) } : news;
}

function plainSplat(layout, buffer) {
  const { count, columns } = layout;
  const floats = columns.map((name, i) => [name, new Float32Array(buffer, 4 * count * i, count)]);
  return splatOf(layout, Object.fromEntries(floats));
}

function untilSeen() {
  return new Promise((resolve) => {
    const look = () => {
      if (document.hidden) return;
      document.removeEventListener("visibilitychange", look);
      resolve();
    };
    document.addEventListener("visibilitychange", look);
    look();
  });
}

async function watchFit() {
  await opened;
  if (!window.viewer) return;  // the viewer says why
  viewer.endTour();  // pictures without end would take the time of the fit
  const line = document.querySelector(".live");
  let version = 0, failures = 0;
  while (failures <= MAX_RETRIES) {
    await untilSeen();
    try {
      const news = await newerThan(version);
      failures = 0;
      if (!news) continue;
      version = news.version;
      line.textContent = news.text;
      if (news.splat) viewer.take(news.splat);
      if (news.isOver) return;
    } catch {
      failures++;
      await new Promise((resolve) => setTimeout(resolve, RETRY_MILLISECONDS));
    }
  }
  line.textContent += " The connection has ended, and with it the fit: its last lines in the terminal say how.";
}

watchFit();

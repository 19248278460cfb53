// Where a viewer's camera shall start, from cameras.json: in the axes of the PLY file, y of a picture is down.

/** how: "camera": as the first camera of the list; "bounds": so far back on its line that the box is in the picture. */
export function start(cameras, how) {
  const { position, rotation, fy, height, bounds } = cameras[0];
  const axis = (k) => rotation.map((row) => row[k]);
  const [down, forward] = [axis(1), axis(2)];
  const fov = 2 * Math.atan(height / 2 / fy);
  const [low, high] = bounds ?? [position, position.map((p, i) => p + 2 * forward[i])];
  const centre = low.map((value, i) => (value + high[i]) / 2);
  const radius = Math.hypot(...low.map((value, i) => high[i] - value)) / 2;
  if (how === "bounds") {
    const back = radius / Math.sin(fov / 2);
    return { position: centre.map((c, i) => c - back * forward[i]), target: centre, up: down.map((d) => -d), fov };
  }
  const ahead = centre.reduce((sum, c, i) => sum + (c - position[i]) * forward[i], 0);
  return { position, target: position.map((p, i) => p + ahead * forward[i]), up: down.map((d) => -d), fov };
}

// The viewers, each as its own documentation starts it. `view`: position, target, up, fov (radians); null: its defaults.

const PLY = `/data/${new URLSearchParams(location.search).get("ply") ?? "splat.ply"}`;
const DEGREES = 180 / Math.PI;
const pause = (seconds) => new Promise((done) => setTimeout(done, 1000 * seconds));

export async function mkkellogg(view) {
  const { SceneRevealMode, Viewer } = await import("@mkkellogg");
  const pose = view && { cameraUp: view.up, initialCameraPosition: view.position, initialCameraLookAt: view.target };
  const viewer = new Viewer({ sharedMemoryForWorkers: false, sceneRevealMode: SceneRevealMode.Instant, ...pose });
  await viewer.addSplatScene(PLY, { showLoadingUI: false });
  if (view) {
    viewer.camera.fov = view.fov * DEGREES;
    viewer.camera.updateProjectionMatrix();
  }
  viewer.start();
  await pause(8);
  document.title = "ready";
}

async function threeScene(view, turned) {
  const THREE = await import("three");
  const camera = new THREE.PerspectiveCamera(view ? view.fov * DEGREES : 60, innerWidth / innerHeight, 0.01, 1000);
  const turn = new THREE.Matrix4().makeRotationX(turned ? Math.PI : 0); // y down to y up
  if (view) {
    camera.position.fromArray(view.position).applyMatrix4(turn);
    camera.up.fromArray(view.up).applyMatrix4(turn);
    camera.lookAt(new THREE.Vector3().fromArray(view.target).applyMatrix4(turn));
  }
  return { THREE, camera, scene: new THREE.Scene() };
}

export async function spark(view) {
  const { THREE, camera, scene } = await threeScene(view, true);
  const { SparkRenderer, SplatMesh } = await import("@sparkjsdev/spark");
  const renderer = new THREE.WebGLRenderer();
  renderer.setSize(innerWidth, innerHeight);
  document.body.append(renderer.domElement);
  scene.add(new SparkRenderer({ renderer }));
  const splats = new SplatMesh({ url: PLY });
  splats.quaternion.set(1, 0, 0, 0); // as in its examples
  scene.add(splats);
  await splats.initialized;
  const box = splats.getBoundingBox(true);
  document.body.dataset.found = JSON.stringify([box.min.toArray(), box.max.toArray()]);
  renderer.setAnimationLoop(() => renderer.render(scene, camera));
  await pause(8);
  document.title = "ready";
}

async function threeOwn(view, add, turned) {
  const { THREE, camera, scene } = await threeScene(view, turned);
  const { WebGPURenderer } = await import("three/webgpu");
  const renderer = new WebGPURenderer();
  if (new URLSearchParams(location.search).has("linear")) renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  renderer.setSize(innerWidth, innerHeight);
  document.body.append(renderer.domElement);
  await renderer.init();
  await add(THREE, scene, camera);
  renderer.setAnimationLoop(() => renderer.render(scene, camera));
  await pause(8);
  document.title = "ready";
}

export const three = (view) =>
  threeOwn(view, async (THREE, scene) => {
    const { GaussianSplatPLYLoader } = await import("three/addons/loaders/GaussianSplatPLYLoader.js");
    const { GaussianSplat } = await import("three/addons/objects/GaussianSplat.js");
    const splat = new GaussianSplat(await new GaussianSplatPLYLoader().loadAsync(PLY));
    splat.rotation.x = Math.PI;
    scene.add(splat);
  }, true);

export async function gsplat(view) {
  const { Camera, Loader, OrbitControls, PLYLoader, Quaternion, Scene, Vector3, WebGLRenderer } = await import("gsplat");
  const { Matrix4, Quaternion: Turn, Vector3: ThreeVector3 } = await import("three");
  const [scene, camera, renderer] = [new Scene(), new Camera(), new WebGLRenderer()];
  document.body.append(renderer.canvas);
  const controls = view ? null : new OrbitControls(camera, renderer.canvas);
  await PLYLoader.LoadAsync(PLY, scene, () => {});
  renderer.setSize(innerWidth, innerHeight);
  if (view) {
    const ahead = new ThreeVector3().fromArray(view.target).sub(new ThreeVector3().fromArray(view.position)).normalize();
    const down = new ThreeVector3().fromArray(view.up).negate();
    const right = down.clone().cross(ahead).normalize();
    const turn = new Turn().setFromRotationMatrix(new Matrix4().makeBasis(right, ahead.clone().cross(right), ahead));
    camera.position = new Vector3(...view.position);
    camera.rotation = new Quaternion(turn.x, turn.y, turn.z, turn.w);
    camera.data.fx = camera.data.fy = innerHeight / 2 / Math.tan(view.fov / 2);
  }
  const frame = () => {
    controls?.update();
    renderer.render(scene, camera);
    requestAnimationFrame(frame);
  };
  frame();
  await pause(8);
  document.title = "ready";
}

// splat.glb is y up by itself; the view, in the axes of the PLY, is turned as its node is.
export const threeGlb = (view) =>
  threeOwn(view, async (THREE, scene, camera) => {
    const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
    const { GLTFGaussianSplatLoaderExtension } = await import("three/addons/loaders/GLTFGaussianSplatLoaderExtension.js");
    const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    const found = (await loader.loadAsync("/data/splat.glb")).scene;
    scene.add(found);
    if (view) {
      const node = found.getObjectByName("splat") ?? found.children[0];
      camera.position.applyQuaternion(node.quaternion); // its translation is the offset, which the PLY has in its numbers
      camera.quaternion.premultiply(node.quaternion);
    }
  }, false);

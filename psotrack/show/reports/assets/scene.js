// A view of a flight in 3D that turns and plays. psotrackScene(host, data) fills the element `host`.
//
// `data` comes from psotrack/show/reports/scene.py: times, drones, truth and cameras, in metres, z up. Arrays
// of numbers are base64 of little-endian float32; NaN where a position is not known.

function psotrackScene(host, data) {
  "use strict";
  const TRAIL_S = 2;
  const decode = (text) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    return new Float32Array(bytes.buffer);
  };
  const time = decode(data.time_s);
  const count = time.length;
  const drones = data.drones.map((drone) => ({
    ...drone,
    position: decode(drone.position_m),
    status: decode(drone.status),
    half: drone.half_axes_m && decode(drone.half_axes_m),
    turn: drone.rotation_xyzw && decode(drone.rotation_xyzw),
  }));
  const isKnown = (array, row) => Number.isFinite(array[3 * row]);
  const at = (array, row) => [array[3 * row], array[3 * row + 1], array[3 * row + 2]];

  host.classList.add("scene");
  host.innerHTML = `
    <div class="scene-view" tabindex="0" role="application"
      aria-label="3D view: drag to turn, scroll to zoom, right button to move, space to play"></div>
    <div class="scene-bar">
      <button type="button" class="scene-play" aria-label="play">&#9654;</button>
      <input type="range" class="scene-time" min="0" max="${Math.max(count - 1, 0)}" value="0" aria-label="time">
      <output class="scene-clock"></output>
      <select class="scene-speed" aria-label="speed">${[0.1, 0.25, 0.5, 1, 2, 4, 8]
        .map((speed) => `<option value="${speed}"${speed === 1 ? " selected" : ""}>${speed}&times;</option>`)
        .join("")}</select>
      <span class="scene-choices"></span>
      <button type="button" class="scene-reset">reset view</button>
    </div>`;
  const view = host.querySelector(".scene-view");
  const slider = host.querySelector(".scene-time");
  const clock = host.querySelector(".scene-clock");
  const playButton = host.querySelector(".scene-play");
  const speedChoice = host.querySelector(".scene-speed");

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  } catch (error) {
    view.innerHTML = "<p class='scene-none'>This browser shows no 3D graphics (WebGL is off or missing). All other " +
      "parts of the page work.</p>";
    return null;
  }
  const labels = new THREE.CSS2DRenderer();
  labels.domElement.className = "scene-labels";
  view.append(renderer.domElement, labels.domElement);
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(45, 1, 0.01, 10000);
  camera.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(camera, renderer.domElement);
  scene.add(new THREE.AmbientLight(0xffffff, 1.6));
  const sun = new THREE.DirectionalLight(0xffffff, 1.6);
  sun.position.set(1, -2, 3);
  scene.add(sun);

  const inkOf = () => new THREE.Color(getComputedStyle(host).color);
  const inked = []; // materials that have the colour of the page's text
  const materials = []; // wide lines need the size of the view
  const wide = (options) => {
    const material = new THREE.LineMaterial(options);
    materials.push(material);
    return material;
  };
  const pairs = (array, first, last) => {
    const found = [];
    for (let row = first; row < last; row += 1) {
      if (isKnown(array, row) && isKnown(array, row + 1)) found.push(...at(array, row), ...at(array, row + 1));
    }
    return found;
  };
  const segments = (points, material) => {
    const geometry = new THREE.LineSegmentsGeometry();
    geometry.setPositions(points.length ? points : [0, 0, 0, 0, 0, 0]);
    if (!points.length) geometry.instanceCount = 0;
    const line = new THREE.LineSegments2(geometry, material);
    line.frustumCulled = false;
    line.computeLineDistances();
    return line;
  };
  const label = (text, className, colour) => {
    const element = document.createElement("span");
    element.className = `scene-label ${className}`;
    element.textContent = text;
    if (colour) element.style.color = colour;
    return new THREE.CSS2DObject(element);
  };

  const groups = {};
  const groupOf = (name) => {
    if (!groups[name]) {
      groups[name] = new THREE.Group();
      scene.add(groups[name]);
    }
    return groups[name];
  };

  // The floor: a line per step, and the numbers of metres at two edges.
  const [low, high] = data.bounds_m;
  const origin = data.origin_m;
  const extent = Math.max(high[0] - low[0], high[1] - low[1], high[2] - low[2], 1e-6);
  const step = 10 ** Math.floor(Math.log10(extent / 2)) * (extent / 10 ** Math.floor(Math.log10(extent / 2)) > 5 ? 1 : 0.5);
  const floorLines = [];
  const ticks = (axis) => {
    const found = [];
    const from = Math.ceil((low[axis] + origin[axis]) / step - 1e-9);
    for (let n = from; n * step - origin[axis] <= high[axis] + 1e-9; n += 1) found.push(n * step - origin[axis]);
    return found;
  };
  const short = (number) => `${Math.round(number * 1000) / 1000}`;
  for (const x of ticks(0)) {
    floorLines.push(x, low[1], low[2], x, high[1], low[2]);
    const mark = label(short(x + origin[0]), "scene-tick");
    mark.position.set(x, low[1] - step * 0.25, low[2]);
    groupOf("floor").add(mark);
  }
  for (const y of ticks(1)) {
    floorLines.push(low[0], y, low[2], high[0], y, low[2]);
    const mark = label(short(y + origin[1]), "scene-tick");
    mark.position.set(low[0] - step * 0.25, y, low[2]);
    groupOf("floor").add(mark);
  }
  const floorMaterial = wide({ linewidth: 1, transparent: true, opacity: 0.18 });
  inked.push(floorMaterial);
  groupOf("floor").add(segments(floorLines, floorMaterial));
  for (const [text, x, y] of [
    ["x (m)", (low[0] + high[0]) / 2, low[1] - step * 0.6],
    ["y (m)", low[0] - step * 0.6, (low[1] + high[1]) / 2],
  ]) {
    const mark = label(text, "scene-tick");
    mark.position.set(x, y, low[2]);
    groupOf("floor").add(mark);
  }

  for (const each of data.cameras) {
    const lines = [];
    each.corners_m.forEach((corner, number) => {
      lines.push(...each.centre_m, ...corner, ...corner, ...each.corners_m[(number + 1) % 4]);
    });
    const material = wide({ linewidth: 1.2, transparent: true, opacity: 0.6 });
    inked.push(material);
    groupOf("cameras").add(segments(lines, material));
    const mark = label(each.name, "scene-camera");
    mark.position.set(...each.centre_m);
    groupOf("cameras").add(mark);
  }

  for (const each of data.truth) {
    const position = decode(each);
    const material = wide({ linewidth: 1, transparent: true, opacity: 0.7, dashed: true, dashSize: extent / 90, gapSize: extent / 130 });
    inked.push(material);
    groupOf("truth").add(segments(pairs(position, 0, count - 1), material));
  }

  const sphere = new THREE.SphereGeometry(1, 24, 16);
  const trailRows = Math.max(2, Math.min(count, Math.round(TRAIL_S / Math.max((time[count - 1] - time[0]) / Math.max(count - 1, 1), 1e-6))));
  for (const drone of drones) {
    groupOf("paths").add(
      segments(pairs(drone.position, 0, count - 1), wide({ color: drone.colour, linewidth: 1.2, transparent: true, opacity: 0.35 })),
    );
    drone.trail = segments(new Array(6 * trailRows).fill(0), wide({ color: drone.colour, linewidth: 3.5 }));
    scene.add(drone.trail);
    drone.body = new THREE.Mesh(sphere, new THREE.MeshLambertMaterial({ color: drone.colour, transparent: true }));
    drone.body.scale.set(...drone.size_m.map((length) => length / 2));
    scene.add(drone.body);
    drone.label = label(drone.name, "scene-drone", drone.colour);
    groupOf("names").add(drone.label);
    if (drone.half) {
      drone.ellipsoid = new THREE.Mesh(
        sphere,
        new THREE.MeshLambertMaterial({ color: drone.colour, transparent: true, opacity: 0.3, depthWrite: false }),
      );
      groupOf("90 % ellipsoids x 10").add(drone.ellipsoid);
    }
  }

  const choices = host.querySelector(".scene-choices");
  for (const [name, group] of Object.entries(groups)) {
    if (name === "floor" || !group.children.length) continue;
    const box = document.createElement("label");
    const input = document.createElement("input");
    input.type = "checkbox";
    input.checked = !name.includes("ellipsoids");
    group.visible = input.checked;
    input.addEventListener("change", () => {
      group.visible = input.checked;
      draw();
    });
    box.append(input, ` ${name}`);
    choices.append(box);
  }

  const middle = new THREE.Vector3(...low.map((value, axis) => (value + high[axis]) / 2));
  const home = () => {
    // A narrow view needs a larger distance to show the whole width.
    const away = extent * 1.05 * Math.max(1, 1.3 / camera.aspect);
    controls.target.copy(middle);
    camera.position.copy(middle).add(new THREE.Vector3(-0.55, -1.0, 0.75).multiplyScalar(away));
    camera.near = extent / 1000;
    camera.far = extent * 100;
    camera.updateProjectionMatrix();
    controls.update();
  };

  let row = 0;
  let playing = false;
  let clockStart = 0;
  let timeStart = 0;
  const show = (wanted) => {
    row = Math.max(0, Math.min(count - 1, wanted));
    slider.value = `${row}`;
    clock.textContent = `${time[row].toFixed(2)} s`;
    for (const drone of drones) {
      const there = isKnown(drone.position, row) && drone.status[row] < 2;
      drone.body.visible = there;
      drone.label.visible = there;
      if (drone.ellipsoid) drone.ellipsoid.visible = there && isKnown(drone.half, row);
      if (there) {
        const place = at(drone.position, row);
        drone.body.position.set(...place);
        drone.body.material.opacity = drone.status[row] === 0 ? 0.95 : 0.3;
        drone.label.position.set(place[0], place[1], place[2] + drone.size_m[2] / 2 + extent / 60);
        drone.label.element.classList.toggle("scene-coasting", drone.status[row] === 1);
        if (drone.ellipsoid && drone.ellipsoid.visible) {
          drone.ellipsoid.position.set(...place);
          drone.ellipsoid.scale.set(...at(drone.half, row).map((half) => 10 * half));
          drone.ellipsoid.quaternion.set(...drone.turn.slice(4 * row, 4 * row + 4));
        }
      }
      const points = pairs(drone.position, Math.max(0, row - trailRows), row);
      const buffer = drone.trail.geometry.attributes.instanceStart.data;
      buffer.array.set(points);
      buffer.needsUpdate = true;
      drone.trail.geometry.instanceCount = points.length / 6;
    }
    draw();
  };
  const rowAt = (seconds) => {
    let first = 0;
    let last = count - 1;
    while (first < last) {
      const half = (first + last + 1) >> 1;
      if (time[half] <= seconds + 1e-6) first = half;
      else last = half - 1;
    }
    return first;
  };
  const draw = () => {
    renderer.render(scene, camera);
    labels.render(scene, camera);
  };
  const tick = (now) => {
    if (!playing) return;
    const seconds = timeStart + ((now - clockStart) / 1000) * Number(speedChoice.value);
    show(rowAt(seconds));
    if (row >= count - 1) pause();
    else requestAnimationFrame(tick);
  };
  const play = () => {
    if (row >= count - 1) show(0);
    playing = true;
    playButton.innerHTML = "&#10074;&#10074;";
    playButton.setAttribute("aria-label", "pause");
    clockStart = performance.now();
    timeStart = time[row];
    requestAnimationFrame(tick);
  };
  const pause = () => {
    playing = false;
    playButton.innerHTML = "&#9654;";
    playButton.setAttribute("aria-label", "play");
  };
  const seek = (seconds) => {
    pause();
    show(rowAt(seconds));
  };

  if (count < 2) host.querySelector(".scene-bar").classList.add("scene-still");

  playButton.addEventListener("click", () => (playing ? pause() : play()));
  speedChoice.addEventListener("change", () => {
    clockStart = performance.now();
    timeStart = time[row];
  });
  slider.addEventListener("input", () => {
    pause();
    show(Number(slider.value));
  });
  host.querySelector(".scene-reset").addEventListener("click", () => {
    home();
    draw();
  });
  view.addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: -1, ArrowRight: 1, PageDown: -25, PageUp: 25 };
    if (event.key === " ") (playing ? pause : play)();
    else if (event.key in steps) {
      pause();
      show(row + steps[event.key]);
    } else return;
    event.preventDefault();
  });
  controls.addEventListener("change", draw);
  const resize = () => {
    const width = view.clientWidth;
    const height = view.clientHeight;
    if (!width || !height) return;
    renderer.setPixelRatio(window.devicePixelRatio);
    renderer.setSize(width, height);
    labels.setSize(width, height);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    for (const material of materials) material.resolution.set(width, height);
    draw();
  };
  const recolour = () => {
    const ink = inkOf();
    for (const material of inked) material.color.copy(ink);
    draw();
  };
  new ResizeObserver(resize).observe(view);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
  resize();
  home();
  recolour();
  show(0);
  host.scene = { play, pause, seek, show, row: () => row, isPlaying: () => playing };
  return host.scene;
}

// The library is stored compressed; browsers since 2023 unpack it themselves.
async function psotrackStart(packed, start) {
  "use strict";
  const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);
  start();
}

"use strict";
/* What the page shows and what can be moved in it. All geometry comes from `Formulas`; the image on the right is made of
 * cells whose corners are looked up in the image on the left, by WebGL where there is it, else pixel by pixel.
 */
const Viewer = (() => {
  const $ = (id) => document.getElementById(id);
  const DATA = JSON.parse($("data").textContent);
  const RADIAN = Math.PI / 180;
  const MOST_PIXELS = 120e6, MOST_BYTES = 400e6; // of a photograph that is tried
  const TEXTURE = 2048, SCENE = 1280; // px of the longer side of photographs, and of drawn scenes
  const PROJECTIONS = {
    // the model, its coefficients, the widest angle, and how wide its plane is of an angle in radians
    perspective: ["pinhole", [], 160, (angle) => 2 * Math.tan(angle / 2)],
    cylindrical: ["cylindrical", [], 360, (angle) => angle],
    equirectangular: ["equirectangular", [], 360, (angle) => angle],
    stereographic: ["ucm", [0.5], 340, (angle) => 4 * Math.tan(angle / 4)],
  };

  // -- what is shown

  const state = {
    model: "kannala_brandt", intrinsics: [], distortion: [], size: [0, 0], title: "",
    picture: "board", projection: "perspective", fov: 100, yaw: 0, pitch: 0,
  };
  let first = null; // the lens as it was when it was chosen
  let trouble = ""; // why there is no camera of these numbers
  let camera = null, target = null, targetRays = null, photograph = null;
  let labels = { points: [], box: [0, 0, 0, 0] };
  const waiting = { lens: false, view: false };
  let asked = 0; // the number of the frame that was asked for
  const ask = (what) => {
    waiting[what] = true;
    asked ||= requestAnimationFrame(guarded);
  };
  const viewSize = [1280, 720];

  function tell(text, isTrouble = false) {
    $("message").textContent = text;
    $("message").className = isTrouble ? "trouble" : "";
  }

  function coefficientNames(model, count) {
    const known = DATA.models[model];
    if (DATA.camera && DATA.camera.model === model && DATA.camera.names.length === count) return DATA.camera.names;
    if (!known.counts.includes(count)) return null;
    if (model !== "tabulated") return known.names.slice(0, count);
    return ["theta", "r"].flatMap((name) => Array.from({ length: count / 2 }, (_, i) => `${name}${i + 1}`));
  }

  function choose(lens, title = "") {
    const { model, intrinsics, distortion, image_size } = lens;
    Object.assign(state, { model, title, intrinsics: [...intrinsics], distortion: [...distortion], size: [...image_size] });
    if (photograph && state.picture === "photograph") fitToPhotograph();
    first = structuredClone({ model, intrinsics: state.intrinsics, distortion, image_size: state.size, title });
    makeSliders();
    ask("lens");
  }

  // -- the address

  function readAddress() {
    const given = new URLSearchParams(location.hash.slice(1));
    document.body.classList.toggle("small", given.has("small"));
    if (![...given.keys()].length) return;
    const numbers = (key) => (given.get(key) ? given.get(key).split(",").map(Number) : null);
    const own = DATA.camera && !given.has("model") ? DATA.camera : null;
    const key = given.get("model") ?? own?.model ?? "kannala_brandt";
    if (!Object.hasOwn(DATA.models, key)) {
      tell(`The address asks for the model ${key}, which this page does not know; it shows another one.`, true);
      return;
    }
    const preset = own ?? DATA.models[key];
    const lens = {
      model: key,
      intrinsics: numbers("f") && numbers("c") ? [...numbers("f"), ...numbers("c")] : preset.intrinsics,
      distortion: given.has("k") ? numbers("k") ?? [] : preset.distortion,
      image_size: numbers("size")?.reverse() ?? preset.image_size,
    };
    const sides = lens.image_size.length === 2 && lens.image_size.every((side) => side >= 1 && side <= 20000);
    if (!sides || !coefficientNames(key, lens.distortion.length)) {
      tell(`The address gives ${key} another number of coefficients or no size; the page shows its own one.`, true);
      Object.assign(lens, { ...DATA.models[key], model: key });
    }
    choose(lens, (given.get("lens") ?? "").replace(/[\p{C}\p{Zl}\p{Zp}]/gu, " ").slice(0, 160)); // a comment of one line
    const projection = given.get("view");
    if (Object.hasOwn(PROJECTIONS, projection ?? "") || Object.hasOwn(DATA.models, projection ?? "")) state.projection = projection;
    for (const name of ["fov", "yaw", "pitch"])
      if (Number.isFinite(parseFloat(given.get(name)))) state[name] = parseFloat(given.get(name));
    state.pitch = Math.min(90, Math.max(-90, state.pitch));
    if (["board", "driver"].includes(given.get("picture"))) state.picture = given.get("picture");
    ask("view");
  }

  function address() {
    const [fx, fy, cx, cy] = state.intrinsics;
    const parts = { model: state.model, size: [state.size[1], state.size[0]], f: [fx, fy], c: [cx, cy] };
    if (state.distortion.length) parts.k = state.distortion;
    if (state.title) parts.lens = encodeURIComponent(state.title);
    if (document.body.classList.contains("small")) parts.small = 1;
    if (state.picture !== "photograph") parts.picture = state.picture;
    Object.assign(parts, { view: state.projection, fov: state.fov, yaw: state.yaw, pitch: state.pitch });
    return `#${Object.entries(parts).map(([name, value]) => `${name}=${value}`).join("&")}`;
  }

  let addressTimer = 0;
  function keepAddress() {
    clearTimeout(addressTimer);
    addressTimer = setTimeout(() => {
      try {
        history.replaceState(null, "", address());
      } catch { /* a frame without an address of its own */ }
    }, 300);
  }

  // -- the image of the lens: a photograph, or a scene drawn through the lens

  const source = document.createElement("canvas");
  const sourceContext = () => source.getContext("2d", { willReadFrequently: renderer.kind === "canvas" });

  function fitToPhotograph() {
    const [height, width] = state.size, { width: w, height: h } = photograph;
    if (w === width && h === height) return;
    const [fx, fy, cx, cy] = state.intrinsics, across = w / width, down = h / height;
    if (Math.abs(across / down - 1) < 0.01) {
      const moved = (c, scale) => (c + 0.5) * scale - 0.5;
      state.intrinsics = [fx * across, fy * down, moved(cx, across), moved(cy, down)];
      tell(`The lens, calibrated for ${width} x ${height}, was scaled to the photograph's ${w} x ${h}.`);
    } else {
      state.intrinsics = [fx * across, fy * across, (w - 1) / 2, (h - 1) / 2];
      tell(`The lens is for images of another shape, ${width} x ${height}; its centre was put into the photograph's middle.`, true);
    }
    state.size = [h, w];
  }

  async function takePhotograph(blob, name, size = null) {
    // size: [height, width] of what is kept smaller than it was
    const trouble = (text) => tell(`${name}: ${text}`, true);
    if (blob.size > MOST_BYTES) return trouble(`a file of ${Math.round(blob.size / 1e6)} MB is more than this page takes.`);
    let bitmap;
    try {
      bitmap = await createImageBitmap(blob);
    } catch {
      return trouble("this file is no image that the browser can read, or it is damaged.");
    }
    const [height, width] = size ?? [bitmap.height, bitmap.width];
    if (width * height > MOST_PIXELS) {
      bitmap.close();
      return trouble(`${width} x ${height} pixels are more than this page takes.`);
    }
    const scale = Math.min(1, TEXTURE / Math.max(width, height)), canvas = document.createElement("canvas");
    canvas.width = Math.max(1, Math.round(scale * width));
    canvas.height = Math.max(1, Math.round(scale * height));
    canvas.getContext("2d").drawImage(bitmap, 0, 0, canvas.width, canvas.height);
    bitmap.close();
    photograph = { canvas, width, height };
    if (!$("picture").querySelector("[value=photograph]")) $("picture").append(new Option("the photograph", "photograph"));
    tell(`${name}: ${width} x ${height} pixels.`);
    state.picture = "photograph";
    fitToPhotograph();
    const half = 0.12 * Math.min(width, height), [u, v] = [width / 2, height / 2];
    labels = {
      points: [[-0.45, -0.3], [0.45, -0.3], [0, 0.1], [-0.35, 0.5], [0.35, 0.5]].map(([x, y]) => [u + half * x, v + half * y]),
      box: [u - half, v - 1.2 * half, u + half, v + 1.2 * half],
    };
    makeSliders();
    ask("lens");
  }

  // Scenes are flat polygons in space, x right, y down, z ahead, in metres, from the furthest to the nearest
  function wall(corner, across, down, cells, [light, dark]) {
    const faces = [];
    const at = (i, j) => corner.map((w, n) => w + (across[n] * i) / cells[0] + (down[n] * j) / cells[1]);
    for (let j = 0; j < cells[1]; j++)
      for (let i = 0; i < cells[0]; i++)
        faces.push({ colour: (i + j) % 2 ? dark : light, corners: [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)] });
    return faces;
  }

  function roomOf(x, top, bottom, back, front, cells, colours) {
    const depth = front - back, tall = bottom - top, [n, m, l] = cells;
    return [
      ...wall([-x, top, back], [2 * x, 0, 0], [0, tall, 0], [n, m], colours.back),
      ...wall([-x, top, back], [2 * x, 0, 0], [0, 0, depth], [n, l], colours.above),
      ...wall([-x, bottom, back], [2 * x, 0, 0], [0, 0, depth], [n, l], colours.below),
      ...wall([-x, top, back], [0, 0, depth], [0, tall, 0], [l, m], colours.left),
      ...wall([x, top, back], [0, 0, depth], [0, tall, 0], [l, m], colours.right),
      ...wall([-x, top, front], [2 * x, 0, 0], [0, tall, 0], [n, m], colours.front),
    ];
  }

  const ellipse = (x, y, z, a, b, colour, lean = 0) => ({
    colour,
    corners: Array.from({ length: 32 }, (_, i) => {
      const [c, s] = [Math.cos((i * Math.PI) / 16), Math.sin((i * Math.PI) / 16)];
      return [x + a * c, y + b * s, z + lean * s];
    }),
  });
  const outline = (colour, z, ...points) => ({ colour, corners: points.map(([x, y, w]) => [x, y, w ?? z]) });

  const SCENES = {
    board: {
      faces: [
        ...roomOf(3, -1.5, 1.3, -4, 4, [12, 6, 16], {
          front: ["#7fa3c7", "#5b82ab"], back: ["#b98a86", "#a06f6b"], left: ["#8fb58b", "#6d996a"],
          right: ["#c9b27c", "#ad945c"], above: ["#dfe3e6", "#c3cace"], below: ["#9b8b7d", "#7f7064"],
        }),
        outline("#ffffff", 1.3, [-0.66, -0.5], [0.66, -0.5], [0.66, 0.5], [-0.66, 0.5]),
        ...wall([-0.6, -0.44, 1.3], [1.2, 0, 0], [0, 0.88, 0], [10, 7], ["#15181b", "#ffffff"]),
      ],
      points: [[-0.48, -0.314, 1.3], [0.48, -0.314, 1.3], [0, 0, 1.3], [-0.48, 0.314, 1.3], [0.48, 0.314, 1.3]],
      box: [[-0.66, -0.5, 1.3], [0.66, 0.5, 1.3]],
    },
    driver: {
      faces: [
        ...roomOf(0.85, -0.62, 0.75, -0.7, 1.9, [6, 4, 10], {
          front: ["#a9bccb", "#9db1c1"], back: ["#3a4046", "#33383d"], left: ["#4a5157", "#434a50"],
          right: ["#4a5157", "#434a50"], above: ["#b9b4aa", "#b1aca2"], below: ["#3c3a3a", "#343232"],
        }),
        ...[-0.849, 0.849].flatMap((x) => [[0.1, 0.85], [0.95, 1.7]].map(([from, to]) =>
          outline("#bcd6e8", 0, [x, -0.45, from], [x, -0.45, to], [x, -0.02, to], [x, -0.02, from]))),
        outline("#2c3136", 1.5, [-0.75, 0.0], [0.75, 0.0], [0.75, 0.6], [-0.75, 0.6]),
        ...[0.0, 0.62].flatMap((x) => [
          outline("#394149", 0.95, [x - 0.25, -0.12], [x + 0.25, -0.12], [x + 0.28, 0.65], [x - 0.28, 0.65]),
          ellipse(x, -0.22, 0.94, 0.14, 0.1, "#2f363d"),
        ]),
        outline("#2d5f8b", 0.8, [-0.11, 0.1], [0.11, 0.1], [0.27, 0.22], [0.31, 0.62], [-0.31, 0.62], [-0.27, 0.22]),
        outline("#c68f72", 0.78, [-0.05, 0.02], [0.05, 0.02], [0.06, 0.13], [-0.06, 0.13]),
        ellipse(0, -0.1, 0.72, 0.098, 0.135, "#3b2a22"),
        ellipse(0, -0.06, 0.7, 0.082, 0.12, "#dca887"),
        ...[-0.035, 0.035].flatMap((x) => [
          ellipse(x, -0.08, 0.69, 0.017, 0.009, "#ffffff"),
          ellipse(x, -0.08, 0.689, 0.008, 0.008, "#33261f"),
          outline("#3b2a22", 0.689, [x - 0.02, -0.104], [x + 0.02, -0.104], [x + 0.018, -0.098], [x - 0.018, -0.098]),
        ]),
        outline("#c08a6a", 0.68, [0, -0.075], [0.013, -0.03], [-0.013, -0.03]),
        ellipse(0, 0.005, 0.69, 0.028, 0.009, "#a5504c"),
        outline("#e0392f", 0.74, [0.1, 0.11], [0.14, 0.13], [-0.2, 0.6], [-0.25, 0.58]),
        ellipse(0, 0.36, 0.42, 0.19, 0.13, "#1c1f22", -0.08),
        ellipse(0, 0.36, 0.419, 0.165, 0.11, "#343a40", -0.07),
        ellipse(0, 0.36, 0.418, 0.06, 0.04, "#1c1f22", -0.03),
      ],
      points: [[-0.035, -0.08, 0.69], [0.035, -0.08, 0.69], [0, -0.03, 0.68], [-0.028, 0.005, 0.69], [0.028, 0.005, 0.69]],
      box: [[-0.1, -0.22, 0.7], [0.1, 0.07, 0.7]],
    },
  };

  function pathOf(corners, steps, scale) {
    // the outline in pixels of the canvas, null if a part of it has no pixel or it is torn apart
    const path = [], far = 0.4 * Math.max(...state.size);
    for (let i = 0; i < corners.length; i++) {
      const p = corners[i], q = corners[(i + 1) % corners.length];
      for (let j = 0; j < steps; j++) {
        const t = j / steps, pixel = camera.project(...p.map((w, n) => w + (q[n] - w) * t));
        if (!pixel) return null;
        const last = path[path.length - 1];
        if (last && (Math.abs(pixel[0] - last[0]) > far || Math.abs(pixel[1] - last[1]) > far)) return null;
        path.push(pixel);
      }
    }
    const [p, q] = [path[0], path[path.length - 1]];
    if (Math.abs(p[0] - q[0]) > far || Math.abs(p[1] - q[1]) > far) return null;
    return path.map(([u, v]) => [(u + 0.5) * scale, (v + 0.5) * scale]);
  }

  function drawFace(context, corners, colour, scale, depth) {
    const path = pathOf(corners, corners.length > 8 ? 1 : depth > 2 ? 1 : 5, scale);
    if (path) {
      context.fillStyle = context.strokeStyle = colour;
      context.beginPath();
      path.forEach(([u, v]) => context.lineTo(u, v));
      context.closePath();
      context.fill();
      context.stroke(); // no gap to the next one
    } else if (depth < 4 && corners.length === 4) {
      const [height, width] = state.size, middle = (p, q) => p.map((w, n) => (w + q[n]) / 2), [a, b, c, d] = corners;
      const [ab, bc, cd, da, all] = [middle(a, b), middle(b, c), middle(c, d), middle(d, a), middle(a, c)];
      const isNear = (corner) => {
        const pixel = camera.project(...corner);
        return pixel && Math.abs(pixel[0] - width / 2) < 2 * width && Math.abs(pixel[1] - height / 2) < 2 * height;
      };
      for (const part of [[a, ab, all, da], [ab, b, bc, all], [all, bc, c, cd], [da, all, cd, d]])
        if (part.some(isNear)) drawFace(context, part, colour, scale, depth + 1);
    }
  }

  function drawSource() {
    const [height, width] = state.size;
    if (state.picture === "photograph") {
      source.width = photograph.canvas.width;
      source.height = photograph.canvas.height;
      sourceContext().drawImage(photograph.canvas, 0, 0);
      return;
    }
    const scale = SCENE / Math.max(width, height), scene = SCENES[state.picture];
    source.width = Math.max(1, Math.round(scale * width));
    source.height = Math.max(1, Math.round(scale * height));
    const context = sourceContext();
    context.fillStyle = "#000000";
    context.fillRect(0, 0, source.width, source.height);
    for (const face of scene.faces) drawFace(context, face.corners, face.colour, scale, 0);
    const [near, far] = scene.box;
    const edges = Array.from({ length: 32 }, (_, i) => {
      const t = (i % 8) / 8, side = i >> 3;
      const [x, y] = [[t, 0], [1, t], [1 - t, 1], [0, 1 - t]][side];
      return camera.project(near[0] + (far[0] - near[0]) * x, near[1] + (far[1] - near[1]) * y, near[2]);
    }).filter(Boolean);
    const [u, v] = [edges.map((p) => p[0]), edges.map((p) => p[1])];
    labels = {
      points: scene.points.map((p) => camera.project(...p)).filter(Boolean),
      box: edges.length ? [Math.min(...u), Math.min(...v), Math.max(...u), Math.max(...v)] : [0, 0, 0, 0],
    };
  }

  // -- the image on the left

  function polyline(context, points, isClosed = false) {
    // pieces between points that are null, or far from the one before
    let last = null;
    const [height, width] = state.size, far = Math.max(height, width);
    context.beginPath();
    for (const point of isClosed ? [...points, points[0]] : points) {
      if (point && last && Math.hypot(point[0] - last[0], point[1] - last[1]) < far) context.lineTo(...point);
      else if (point) context.moveTo(...point);
      last = point;
    }
    context.stroke();
  }

  const boxOutline = ([left, top, right, bottom], steps = 16) =>
    [[left, top], [right, top], [right, bottom], [left, bottom]].flatMap(([u, v], i, all) => {
      const [p, q] = all[(i + 1) % 4];
      return Array.from({ length: steps }, (_, j) => [u + ((p - u) * j) / steps, v + ((q - v) * j) / steps]);
    });

  function drawLabels(context, points, box, enclosing, line) {
    context.strokeStyle = "#1f8fff";
    context.lineWidth = line;
    polyline(context, box, true);
    if (enclosing) {
      context.setLineDash([4 * line, 3 * line]);
      context.strokeRect(enclosing[0], enclosing[1], enclosing[2] - enclosing[0], enclosing[3] - enclosing[1]);
      context.setLineDash([]);
    }
    context.fillStyle = "#1f8fff";
    context.strokeStyle = "#ffffff";
    context.lineWidth = line / 2;
    for (const point of points.filter(Boolean)) {
      context.beginPath();
      context.arc(...point, 1.8 * line, 0, 2 * Math.PI);
      context.fill();
      context.stroke();
    }
  }

  function drawLeft() {
    const canvas = $("left"), context = canvas.getContext("2d"), [height, width] = state.size;
    const larger = Math.max(1, SCENE / Math.max(source.width, source.height)); // lines are fine on small photographs too
    const [across, down] = [source.width, source.height].map((side) => Math.round(larger * side));
    if (canvas.width !== across) canvas.width = across;
    if (canvas.height !== down) canvas.height = down;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(source, 0, 0, across, down);
    const scale = canvas.width / width, line = (1.5 * width) / (canvas.clientWidth || 640);
    context.setTransform(scale, 0, 0, canvas.height / height, scale / 2, scale / 2); // to the middles of pixels
    const rim = camera.rim();
    context.fillStyle = "rgba(90, 96, 102, 0.72)";
    context.beginPath();
    context.rect(-1, -1, width + 1, height + 1);
    rim.forEach(([u, v], i) => (i ? context.lineTo(u, v) : context.moveTo(u, v)));
    context.closePath();
    context.fill("evenodd");
    context.strokeStyle = "#f06a1d";
    context.lineWidth = 1.3 * line;
    context.beginPath();
    rim.forEach(([u, v]) => context.lineTo(u, v));
    context.closePath();
    context.stroke();

    context.lineWidth = 0.6 * line;
    context.font = `${8 * line}px system-ui, sans-serif`;
    const most = furthestAngle() / RADIAN, step = [1, 2, 5, 10, 15, 30].find((s) => most / s < 7) ?? 30;
    let labelled = null; // at the rim of a fisheye circles lie closer than their numbers are wide
    for (let angle = step; angle < 180; angle += step) {
      const circle = Array.from({ length: 121 }, (_, i) => onCircle(angle * RADIAN, (i * Math.PI) / 60));
      if (!circle.some(Boolean)) break;
      context.setLineDash([1.5 * line, 2 * line]);
      context.strokeStyle = "#ffffff";
      polyline(context, circle);
      context.strokeStyle = "#000000";
      context.lineDashOffset = 1.75 * line;
      polyline(context, circle);
      context.lineDashOffset = 0;
      context.setLineDash([]);
      const place = circle[0] && circle[0][0] < width - 14 * line ? circle[0] : circle[60];
      if (!place || (labelled && Math.hypot(place[0] - labelled[0], place[1] - labelled[1]) < 18 * line)) continue;
      labelled = place;
      context.strokeStyle = "#000000";
      context.fillStyle = "#ffffff";
      context.strokeText(`${angle}°`, place[0] + line, place[1] - line);
      context.fillText(`${angle}°`, place[0] + line, place[1] - line);
    }
    context.strokeStyle = "#f2d024";
    context.lineWidth = line;
    polyline(context, footprint(), true);
    drawLabels(context, labels.points, boxOutline(labels.box), null, line);
  }

  const onCircle = (theta, phi) =>
    camera.project(Math.sin(theta) * Math.cos(phi), Math.sin(theta) * Math.sin(phi), Math.cos(theta));

  function furthestAngle() {
    // that the image has, by its corners and the middles of its sides
    const [h, w] = state.size, [, , cx, cy] = state.intrinsics;
    const seen = [[0, 0], [w, 0], [0, h], [w, h], [cx, 0], [cx, h], [0, cy], [w, cy]]
      .map(([u, v]) => camera.unproject(u - 0.5, v - 0.5)).filter(Boolean).map((ray) => Math.acos(ray[2]));
    return seen.length ? Math.max(...seen) : camera.reach(0);
  }

  // -- the image on the right

  function turned() {
    // target ray to source ray: a turn to the right, then up
    const [c, s] = [Math.cos(state.yaw * RADIAN), Math.sin(state.yaw * RADIAN)];
    const [cp, sp] = [Math.cos(state.pitch * RADIAN), Math.sin(state.pitch * RADIAN)];
    return [[c, s * sp, s * cp], [0, cp, -sp], [-s, c * sp, c * cp]];
  }

  const apply = (m, [x, y, z]) => m.map((row) => row[0] * x + row[1] * y + row[2] * z);
  const back = (m, [x, y, z]) => [0, 1, 2].map((i) => m[0][i] * x + m[1][i] * y + m[2][i] * z);

  function targetLens() {
    const [width, height] = viewSize, centre = [(width - 1) / 2, (height - 1) / 2];
    if (state.projection in PROJECTIONS) {
      const [model, distortion, widest, plane] = PROJECTIONS[state.projection];
      state.fov = Math.min(Math.max(state.fov, 5), widest);
      const focal = width / plane(state.fov * RADIAN);
      return { model, intrinsics: [focal, focal, ...centre], distortion };
    }
    const preset = DATA.models[state.projection], [h, w] = preset.image_size, [fx, fy, cx, cy] = preset.intrinsics;
    const scale = Math.min(width / w, height / h);
    const moved = (c, side, room) => (c - (side - 1) / 2) * scale + (room - 1) / 2;
    const intrinsics = [fx * scale, fy * scale, moved(cx, w, width), moved(cy, h, height)];
    return { model: state.projection, intrinsics, distortion: preset.distortion };
  }

  const CELL = 16; // px of the target
  function makeTarget() {
    const { model, intrinsics, distortion } = targetLens(), key = JSON.stringify([model, intrinsics, distortion, viewSize]);
    if (target?.key === key) return;
    target = new Formulas.Camera(model, intrinsics, distortion);
    target.key = key;
    targetRays = new Map();
  }

  function lookUp(turn, u, v) {
    // where in the source the corner (u, v) of target pixels is, in parts of its width and height
    const place = u * 65536 + v;
    let ray = targetRays.get(place);
    if (ray === undefined) {
      ray = target.unproject(u - 0.5, v - 0.5);
      targetRays.set(place, ray);
    }
    const pixel = ray && camera.project(...apply(turn, ray));
    return pixel && [(pixel[0] + 0.5) / state.size[1], (pixel[1] + 0.5) / state.size[0]];
  }

  function cells() {
    // [left, top, right, bottom, and (s, t) at the corners: left top, right top, left bottom, right bottom], flat
    const turn = turned(), [width, height] = viewSize, found = [];
    const add = (left, top, right, bottom, corners) => {
      if (corners.every(Boolean)) {
        const s = corners.map((c) => c[0]), t = corners.map((c) => c[1]);
        const [s0, s1, t0, t1] = [Math.min(...s), Math.max(...s), Math.min(...t), Math.max(...t)];
        if (s1 < 0 || s0 > 1 || t1 < 0 || t0 > 1) return;
        if (s1 - s0 < 0.3 && t1 - t0 < 0.3) return found.push(left, top, right, bottom, ...corners.flat());
      } else if (!corners.some(Boolean) && right - left < CELL) return undefined;
      if (right - left < 2 || bottom - top < 2) return undefined;
      const [x, y] = [(left + right) >> 1, (top + bottom) >> 1], [a, b, c, d] = corners;
      const [n, s] = [lookUp(turn, x, top), lookUp(turn, x, bottom)];
      const [w, e, m] = [lookUp(turn, left, y), lookUp(turn, right, y), lookUp(turn, x, y)];
      if (![a, b, c, d, n, s, w, e, m].some(Boolean)) return undefined;
      add(left, top, x, y, [a, n, w, m]);
      add(x, top, right, y, [n, b, m, e]);
      add(left, y, x, bottom, [w, m, c, s]);
      add(x, y, right, bottom, [m, e, s, d]);
    };
    let above = null;
    for (let v = 0; ; v = Math.min(v + CELL, height)) {
      const row = [];
      for (let u = 0; u < width + CELL; u += CELL) row.push(lookUp(turn, Math.min(u, width), v));
      if (above)
        for (let i = 0; i + 1 < row.length && i * CELL < width; i++)
          add(i * CELL, above.v, Math.min((i + 1) * CELL, width), v, [above.row[i], above.row[i + 1], row[i], row[i + 1]]);
      if (v === height) return found;
      above = { row, v };
    }
  }

  function glRenderer(canvas, evenSlow) {
    // in software the canvas is faster
    const options = { antialias: false, alpha: false, preserveDrawingBuffer: true };
    const gl = canvas.getContext("webgl2", { ...options, failIfMajorPerformanceCaveat: !evenSlow });
    if (!gl) return null;
    const named = gl.getExtension("WEBGL_debug_renderer_info");
    const name = named ? gl.getParameter(named.UNMASKED_RENDERER_WEBGL) : "";
    if (!evenSlow && /swiftshader|llvmpipe|software/i.test(name)) return null;
    const shader = (kind, text) => {
      const made = gl.createShader(kind);
      gl.shaderSource(made, text);
      gl.compileShader(made);
      return made;
    };
    const program = gl.createProgram();
    gl.attachShader(program, shader(gl.VERTEX_SHADER, `#version 300 es
      in vec4 vertex; uniform vec2 size; out vec2 place;
      void main() { place = vertex.zw; gl_Position = vec4(2.0 * vertex.xy / size - 1.0, 0, 1) * vec4(1, -1, 1, 1); }`));
    gl.attachShader(program, shader(gl.FRAGMENT_SHADER, `#version 300 es
      precision highp float; in vec2 place; uniform sampler2D image; out vec4 colour;
      void main() {
        if (any(lessThan(place, vec2(0))) || any(greaterThan(place, vec2(1)))) discard;
        colour = texture(image, place);
      }`));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
    gl.useProgram(program);
    const place = gl.getAttribLocation(program, "vertex"), size = gl.getUniformLocation(program, "size");
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 4, gl.FLOAT, false, 0, 0);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    return {
      load: () => {
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, source);
        gl.generateMipmap(gl.TEXTURE_2D);
      },
      draw: (found) => {
        const vertices = new Float32Array(2 * found.length);
        for (let i = 0, k = 0; i < found.length; i += 12) {
          const x = [found[i], found[i + 2]], y = [found[i + 1], found[i + 3]];
          for (const corner of [0, 1, 2, 1, 3, 2]) {
            vertices[k++] = x[corner & 1];
            vertices[k++] = y[corner >> 1];
            vertices[k++] = found[i + 4 + 2 * corner];
            vertices[k++] = found[i + 5 + 2 * corner];
          }
        }
        gl.viewport(0, 0, ...viewSize);
        gl.clearColor(0.33, 0.36, 0.38, 1);
        gl.clear(gl.COLOR_BUFFER_BIT);
        gl.uniform2f(size, ...viewSize);
        gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STREAM_DRAW);
        gl.drawArrays(gl.TRIANGLES, 0, vertices.length / 4);
      },
    };
  }

  function canvasRenderer(canvas) {
    const context = canvas.getContext("2d");
    let pixels = null, made = null;
    return {
      load: () => {
        const { width, height } = source;
        pixels = new Uint32Array(sourceContext().getImageData(0, 0, width, height).data.buffer);
      },
      draw: (found) => {
        const [width, height] = viewSize, { width: w, height: h } = source;
        if (made?.width !== width || made?.height !== height) made = context.createImageData(width, height);
        const target = new Uint32Array(made.data.buffer);
        target.fill(0xff615c54);
        for (let i = 0; i < found.length; i += 12) {
          const [left, top, right, bottom, s0, t0, s1, t1, s2, t2, s3, t3] = found.slice(i, i + 12);
          for (let v = top; v < bottom; v++) {
            const q = (v + 0.5 - top) / (bottom - top);
            const [from, to] = [w * (s0 + (s2 - s0) * q), w * (s1 + (s3 - s1) * q)];
            const [start, end] = [h * (t0 + (t2 - t0) * q), h * (t1 + (t3 - t1) * q)];
            const across = (to - from) / (right - left), down = (end - start) / (right - left);
            let x = from + across / 2, y = start + down / 2;
            for (let u = left; u < right; u++, x += across, y += down)
              if (x >= 0 && y >= 0 && x < w && y < h) target[v * width + u] = pixels[(y | 0) * w + (x | 0)];
          }
        }
        context.putImageData(made, 0, 0);
      },
    };
  }

  let renderer = null;

  function makeRenderer(way) {
    // way: "webgl", "canvas", or null for the faster one
    const canvas = document.createElement("canvas"), byGl = way === "canvas" ? null : glRenderer(canvas, way === "webgl");
    if (byGl) renderer = { ...byGl, canvas, kind: "webgl" };
    else {
      const plain = document.createElement("canvas");
      renderer = { ...canvasRenderer(plain), canvas: plain, kind: "canvas" };
      viewSize.splice(0, 2, 640, 480);
    }
  }

  function footprint() {
    // the outline of the target's image in the source
    if (!target) return [];
    const turn = turned(), [width, height] = viewSize;
    return boxOutline([0, 0, width - 1, height - 1], 40).map(([u, v]) => {
      const ray = target.unproject(u, v);
      return ray && camera.project(...apply(turn, ray));
    });
  }

  function drawRight() {
    const canvas = $("right"), [width, height] = viewSize;
    for (const each of [canvas, renderer.canvas]) {
      if (each.width !== width) each.width = width;
      if (each.height !== height) each.height = height;
    }
    renderer.draw(cells());
    const context = canvas.getContext("2d"), turn = turned();
    context.drawImage(renderer.canvas, 0, 0);
    const moved = ([u, v]) => {
      const ray = camera.unproject(u, v);
      return ray && target.project(...back(turn, ray));
    };
    const outline = boxOutline(labels.box).map(moved), seen = outline.filter(Boolean);
    const whole = seen.length === outline.length && seen.length;
    const [u, v] = [seen.map((p) => p[0]), seen.map((p) => p[1])];
    const enclosing = whole && [Math.min(...u), Math.min(...v), Math.max(...u), Math.max(...v)];
    context.setTransform(1, 0, 0, 1, 0.5, 0.5);
    drawLabels(context, labels.points.map(moved), outline, enclosing, (1.5 * width) / (canvas.clientWidth || 640));
    context.setTransform(1, 0, 0, 1, 0, 0);
  }

  // -- numbers: curve, facts, sliders

  function drawCurve() {
    const canvas = $("curve"), scale = window.devicePixelRatio || 1;
    const style = getComputedStyle(document.documentElement), ink = style.getPropertyValue("--ink");
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width) return;
    canvas.width = width * scale;
    canvas.height = height * scale;
    const context = canvas.getContext("2d"), [fx, , cx] = state.intrinsics, reach = camera.reach(0);
    const most = Math.min(Math.max(1.25 * reach, 1.3 * furthestAngle()), Math.PI);
    const radii = Array.from({ length: 161 }, (_, i) => {
      const theta = (most * i) / 160, pixel = theta < reach ? onCircle(theta, 0) : null;
      return [theta, pixel ? pixel[0] - cx : null];
    });
    const values = radii.map((p) => p[1]).filter((r) => r !== null), highest = Math.max(...values.slice(0, -1), 1);
    const top = Math.min(highest, 2.2 * Math.max(...state.size));
    const at = (theta, r) => [34 + ((width - 44) * theta) / most, height - 20 - ((height - 30) * r) / top];
    context.scale(scale, scale);
    context.font = "12px system-ui, sans-serif";
    context.fillStyle = ink;
    context.strokeStyle = style.getPropertyValue("--line");
    const degrees = most / RADIAN, step = [1, 2, 5, 10, 15, 30, 45].find((s) => degrees / s < 7) ?? 45;
    for (let angle = 0; angle <= degrees; angle += step) {
      const [x] = at(angle * RADIAN, 0);
      context.beginPath();
      context.moveTo(x, 6);
      context.lineTo(x, height - 20);
      context.stroke();
      context.fillText(`${angle}°`, Math.min(x - 8, width - 30), height - 5); // 180° is 28 px wide
    }
    context.fillText(`${Math.round(top)}`, 2, 16);
    context.fillText("px", 2, 30);
    context.save();
    context.beginPath();
    context.rect(34, 4, width - 40, height - 24);
    context.clip();
    const slope = (radii[1][1] ?? fx * radii[1][0]) / radii[1][0];
    const curve = (of, dash, colour, line) => {
      context.setLineDash(dash);
      context.strokeStyle = colour;
      context.lineWidth = line;
      context.beginPath();
      radii.forEach(([theta], i) => of(i) !== null && context.lineTo(...at(theta, of(i))));
      context.stroke();
    };
    const soft = style.getPropertyValue("--soft");
    curve((i) => (radii[i][0] < 1.55 ? slope * Math.tan(radii[i][0]) : null), [6, 4], soft, 1.3);
    curve((i) => slope * radii[i][0], [2, 3], soft, 1.3);
    curve((i) => radii[i][1], [], "#f06a1d", 2.5);
    context.setLineDash([]);
    const end = reach < Math.PI - 1e-3 && onCircle(reach * (1 - 1e-6), 0);
    if (end) {
      context.fillStyle = "#f06a1d";
      context.beginPath();
      context.arc(...at(reach, Math.min(end[0] - cx, top)), 4, 0, 7);
      context.fill();
    }
    context.restore();
    const angles = [[0, state.size[1]], [0, state.size[0]]].map(([, side], axis) => {
      const middle = axis ? [state.intrinsics[2], 0] : [0, state.intrinsics[3]];
      const other = axis ? [state.intrinsics[2], side - 1] : [side - 1, state.intrinsics[3]];
      const rays = [camera.unproject(...middle), camera.unproject(...other)];
      if (!rays.every(Boolean)) return `without rays at its ${axis ? "upper or lower" : "left or right"} edge`;
      return `${Math.round(rays.reduce((sum, r) => sum + Math.acos(r[2]), 0) / RADIAN)}° ${axis ? "high" : "wide"}`;
    });
    $("facts").textContent =
      `${DATA.models[state.model].class}, ${state.size[1]} x ${state.size[0]} px: ${angles[0]}, ${angles[1]}; ` +
      `to the right its rays end at ${(reach / RADIAN).toFixed(1)}°.`;
  }

  function rangeOf(name, value) {
    const natural = { alpha: [0, 1], omega: [-2.5, 2.5], xi: [-0.9, 3], beta: [0.1, 3] }[name];
    if (natural) return [Math.min(natural[0], value), Math.max(natural[1], value)];
    const usual = /^(p|s)/.test(name) ? 0.02 : /^(d|e|tau)/.test(name) ? 0.2 : 0.3, reach = Math.max(usual, 1.5 * Math.abs(value));
    return [value - reach, value + reach];
  }

  function makeSliders() {
    const names = coefficientNames(state.model, state.distortion.length) ?? [], side = Math.max(...state.size);
    const rows = [
      ...["fx", "fy"].map((name, i) => [name, "intrinsics", i, state.intrinsics[i] * 0.3, state.intrinsics[i] * 2.5]),
      ...["cx", "cy"].map((name, i) => [name, "intrinsics", i + 2, state.intrinsics[i + 2] - side / 3, state.intrinsics[i + 2] + side / 3]),
      // the control points of a surface are too many to be moved one by one
      ...(names.length > 60 ? [] : names).map((name, i) => [name, "distortion", i, ...rangeOf(name, state.distortion[i])]),
    ];
    $("sliders").replaceChildren(
      ...rows.flatMap(([name, kind, index, low, high]) => {
        const label = document.createElement("label"), slider = document.createElement("input");
        const number = document.createElement("input");
        Object.assign(label, { textContent: name, htmlFor: `slide-${name}` });
        Object.assign(slider, { type: "range", id: `slide-${name}`, min: low, max: high, step: "any", value: state[kind][index] });
        Object.assign(number, { type: "number", step: "any", value: state[kind][index] });
        number.setAttribute("aria-label", `${name}, as a number`);
        const set = (value, other) => {
          if (value === "" || !Number.isFinite(Number(value))) return tell(`${name} must be a number.`, true);
          tell("");
          state[kind][index] = Number(value);
          other.value = value;
          ask("lens");
          return undefined;
        };
        slider.addEventListener("input", () => set(Number(Number(slider.value).toPrecision(6)), number));
        number.addEventListener("input", () => set(number.value, slider));
        return [label, slider, number];
      }),
    );
  }

  // -- text: Python, the command, files

  const listed = (values) => `[${values.map(numeral).join(", ")}]`;
  const numeral = (value) => {
    // one that Python and every YAML reader take for a number with a fraction
    const text = String(value);
    if (/e/.test(text)) return /\./.test(text) ? text : text.replace("e", ".0e");
    return /\./.test(text) ? text : `${text}.0`;
  };

  function made({ model, intrinsics, distortion }, [height, width]) {
    const own = distortion.length ? `, ${listed(distortion)}` : "";
    return `ct.${DATA.models[model].class}(${listed(intrinsics)}${own}, image_size=(${height}, ${width}))`;
  }

  function python() {
    if (trouble) return `# ${trouble}`;
    const lines = [
      "import numpy as np", "import torch", "from PIL import Image", "import camtorch as ct", "",
      ...(state.title ? [`# ${state.title}: numbers rounded; ct.lenses.search finds the exact ones`] : []),
      `camera = ${made(state, state.size)}`,
    ];
    const turn = turned(), isTurned = state.yaw !== 0 || state.pitch !== 0, [width, height] = viewSize;
    if (isTurned) lines.push(`rotation = [${[0, 1, 2].map((i) => listed([0, 1, 2].map((j) => turn[j][i] + 0))).join(", ")}]`);
    if (state.projection in PROJECTIONS) {
      const rest = isTurned ? ", rotation=rotation" : "";
      lines.push(`warp = ct.Dewarp(camera, projection="${state.projection}", fov=${numeral(state.fov)}, image_size=(${height}, ${width})${rest})`);
    } else {
      lines.push(`target = ${made(targetLens(), [height, width])}`);
      lines.push(`warp = ct.Warp(camera, target${isTurned ? ", rotation" : ""})`);
    }
    return [
      ...lines, "",
      'photo = np.array(Image.open("photo.jpg").convert("RGB"))',
      "image = torch.from_numpy(photo).permute(2, 0, 1)[None]  # (1, 3, H, W)",
      "moved = warp(image)  # the second image",
      'Image.fromarray(moved[0].permute(1, 2, 0).numpy()).save("moved.png")',
      `landmarks, there = warp.transform_points(torch.tensor([${labels.points.map((p) => listed(p.map((w) => +w.toFixed(2)))).join(", ")}]))`,
    ].join("\n");
  }

  function command() {
    if (trouble) return `# ${trouble}`;
    if (!(state.projection in PROJECTIONS)) return "# the lens of another model: the lines of Python do it";
    const [width, height] = viewSize, aside = state.yaw !== 0 || state.pitch !== 0 ? "# without the turn, which the lines of Python do\n" : "";
    return `${aside}camtorch dewarp photo.jpg --camera camera.json --projection ${state.projection} --fov ${state.fov} --size ${width}x${height} -o moved.png`;
  }

  function yamlMatrix(key, rows, cols, data, head = "") {
    return [`${key}:${head}`, `   rows: ${rows}`, `   cols: ${cols}`, ...(head ? ["   dt: d"] : []), `   data: ${listed(data)}`];
  }

  const matrix = ([fx, fy, cx, cy]) => [fx, 0, cx, 0, fy, cy, 0, 0, 1];
  const json = (name, value) => [name, `${JSON.stringify(value, null, 2)}\n`];
  const named = (names, values) => Object.fromEntries(names.map((name, i) => [name, values[i]]));
  const COLMAP = {
    pinhole: { 0: "PINHOLE" }, brown_conrady: { 4: "OPENCV", 8: "FULL_OPENCV" }, kannala_brandt: { 4: "OPENCV_FISHEYE" },
    fov: { 1: "FOV" }, thin_prism_fisheye: { 8: "THIN_PRISM_FISHEYE" }, fisheye624: { 12: "RAD_TAN_THIN_PRISM_FISHEYE" },
    division: { 1: "DIVISION" }, eucm: { 2: "EUCM" },
  };
  const KALIBR = {
    pinhole: ["pinhole", "none", 0, 0], brown_conrady: ["pinhole", "radtan", 0, 4], kannala_brandt: ["pinhole", "equidistant", 0, 4],
    fov: ["pinhole", "fov", 0, 1], mei: ["omni", "radtan", 1, 4], eucm: ["eucm", "none", 2, 0], double_sphere: ["ds", "none", 2, 0],
  };

  // [the format's name, how many focal lengths, and how many coefficients] of a model
  const ARIA = {
    fisheye624: ["FisheyeRadTanThinPrism", 1, 12], fisheye62: ["Fisheye62", 1, 8],
    kannala_brandt: ["KannalaBrandtK3", 2, 4], pinhole: ["Linear", 2, 0],
  };
  const BASALT = {
    pinhole: ["pinhole", []], double_sphere: ["ds", ["xi", "alpha"]], eucm: ["eucm", ["alpha", "beta"]], ucm: ["ucm", ["alpha"]],
    kannala_brandt: ["kb4", ["k1", "k2", "k3", "k4"]], fov: ["fov", ["w"]],
    brown_conrady: ["pinhole-radtan8", ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]],
  };
  const MRCAL = {
    pinhole: [0, "PINHOLE"], equirectangular: [0, "LONLAT"], latlon: [0, "LATLON"], stereographic: [0, "STEREOGRAPHIC"],
  };
  const NERFSTUDIO = {
    pinhole: ["PINHOLE", [[]]], kannala_brandt: ["OPENCV_FISHEYE", [["k1", "k2", "k3", "k4"]]],
    brown_conrady: ["OPENCV", [["k1", "k2", "p1", "p2"], ["k1", "k2", "p1", "p2", "k3"]]],
  };

  // name of the file, and its text; null for a lens that the format cannot hold
  const FORMATS = {
    "camtorch (JSON)": ({ model, intrinsics, distortion, size }, names) => {
      const entry = { model, intrinsics };
      if (names.length) Object.assign(entry, { distortion_names: names, distortion });
      return ["camera.json", `${JSON.stringify({ camtorch: 1, cameras: { camera: { ...entry, image_size: size } }, extrinsics: {} }, null, 2)}\n`];
    },
    "OpenCV (YAML)": ({ model, intrinsics, distortion, size }) => {
      const n = distortion.length, isFisheye = model === "kannala_brandt";
      if (!["pinhole", "brown_conrady", "mei"].includes(model) && !(isFisheye && n === 4)) return null;
      const rest = model === "mei" ? distortion.slice(1) : distortion;
      return ["camera.yml", [
        "%YAML:1.0", "---", `image_width: ${size[1]}`, `image_height: ${size[0]}`,
        ...(model === "mei" ? [`xi: ${numeral(distortion[0])}`] : n === 4 ? [`fisheye_model: ${Number(isFisheye)}`] : []),
        ...yamlMatrix("camera_matrix", 3, 3, matrix(intrinsics), " !!opencv-matrix"),
        ...(rest.length ? yamlMatrix("distortion_coefficients", rest.length, 1, rest, " !!opencv-matrix") : []), "",
      ].join("\n")];
    },
    "ROS camera_info (YAML)": ({ model, intrinsics, distortion, size }) => {
      const n = distortion.length, isFisheye = model === "kannala_brandt" && n === 4;
      if (!["pinhole", "brown_conrady"].includes(model) && !isFisheye) return null;
      const [fx, fy, cx, cy] = intrinsics;
      return ["camera_info.yaml", [
        `image_width: ${size[1]}`, `image_height: ${size[0]}`, "camera_name: camera",
        ...yamlMatrix("camera_matrix", 3, 3, matrix(intrinsics)),
        `distortion_model: ${isFisheye ? "equidistant" : n > 5 ? "rational_polynomial" : "plumb_bob"}`,
        ...yamlMatrix("distortion_coefficients", 1, n, distortion),
        ...yamlMatrix("rectification_matrix", 3, 3, [1, 0, 0, 0, 1, 0, 0, 0, 1]),
        ...yamlMatrix("projection_matrix", 3, 4, [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]), "",
      ].join("\n")];
    },
    "Kalibr (YAML)": ({ model, intrinsics, distortion, size }) => {
      const [camera_model, distortion_model, before, after] = KALIBR[model] ?? [];
      if (!camera_model || distortion.length !== before + after) return null;
      return ["camchain.yaml", [
        "cam0:", `  camera_model: ${camera_model}`, `  distortion_model: ${distortion_model}`,
        `  intrinsics: ${listed([...distortion.slice(0, before), ...intrinsics])}`,
        `  distortion_coeffs: ${listed(distortion.slice(before))}`, `  resolution: [${size[1]}, ${size[0]}]`,
        "  cam_overlaps: []", "  rostopic: /cam0/image_raw", "",
      ].join("\n")];
    },
    "COLMAP (text)": ({ model, intrinsics: [fx, fy, cx, cy], distortion, size }) => {
      const name = COLMAP[model]?.[distortion.length];
      if (!name) return null;
      const numbers = [fx, fy, cx + 0.5, cy + 0.5, ...distortion].map(numeral).join(" ");
      return ["cameras.txt", `# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 ${name} ${size[1]} ${size[0]} ${numbers}\n`];
    },
    "Nerfstudio (JSON)": ({ model, intrinsics: [fx, fy, cx, cy], distortion, size: [h, w] }) => {
      const [kind, groups] = NERFSTUDIO[model] ?? ["FISHEYE624", []], names = groups.find((group) => group.length === distortion.length);
      if (!names && model !== "fisheye624") return null;
      const lens = names ? named(names, distortion) : { distortion_params: distortion };
      const core = { camera_model: kind, fl_x: fx, fl_y: fy, cx: cx + 0.5, cy: cy + 0.5, w, h };
      return json("transforms.json", { ...core, ...lens, frames: [] });
    },
    "Aria (JSON)": ({ model, intrinsics: [fx, fy, cx, cy], distortion, size }) => {
      const [Name, focals, count] = ARIA[model] ?? [];
      if (!Name || distortion.length !== count || (focals === 1 && fx !== fy)) return null;
      return json("calibration.json", {
        AlgorithmName: "camtorch", AlgorithmVersion: "1", CalibrationSource: "Unknown",
        CameraCalibrations: [{
          Calibrated: true, ConfigData: { ImageHeight: size[0], ImageWidth: size[1], MaxSolidAngle: Math.PI }, Label: "camera",
          Projection: { Description: `see ${Name}.h`, Name, Params: [...[fx, fy].slice(0, focals), cx, cy, ...distortion] },
          SerialNumber: "0", T_Device_Camera: { Translation: [0, 0, 0], UnitQuaternion: [1, [0, 0, 0]] },
        }],
        DeviceClassInfo: { BuildVersion: "DVT-S", DeviceClass: "Aria" },
        FileFormat: { Tags: [], Timestamp: "", UnixTime: 0, Version: 3 },
        OriginSpecification: { ChildLabel: "camera-slam-left", Type: "Custom" }, Serial: "",
      });
    },
    "Basalt (JSON)": ({ model, intrinsics, distortion, size }) => {
      const [camera_type, names] = BASALT[model] ?? [];
      if (!camera_type || distortion.length !== names.length) return null;
      const values = named(["fx", "fy", "cx", "cy", ...names], [...intrinsics, ...distortion]), zeros = (n) => Array(n).fill(0);
      return json("calibration.json", { value0: {
        T_imu_cam: [{ px: 0, py: 0, pz: 0, qx: 0, qy: 0, qz: 0, qw: 1 }],
        intrinsics: [{ camera_type, intrinsics: model === "brown_conrady" ? { ...values, rpmax: 0 } : values }],
        resolution: [[size[1], size[0]]], calib_accel_bias: zeros(9), calib_gyro_bias: zeros(12), imu_update_rate: 200,
        accel_noise_std: Array(3).fill(0.016), gyro_noise_std: Array(3).fill(0.000282),
        accel_bias_std: Array(3).fill(0.001), gyro_bias_std: Array(3).fill(0.0001), cam_time_offset_ns: 0, vignette: [],
      } });
    },
    "mrcal (cameramodel)": ({ model, intrinsics, distortion, size }) => {
      const n = distortion.length, grid = /^splined:order=(\d+),columns=(\d+),rows=(\d+),fov_x=(\d+)$/.exec(model);
      let [count, name] = MRCAL[model] ?? [null];
      if (model === "brown_conrady") [count, name] = [n, `OPENCV${n}`];
      else if (grid) [count, name] = [n, `SPLINED_STEREOGRAPHIC_order=${grid[1]}_Nx=${grid[2]}_Ny=${grid[3]}_fov_x_deg=${grid[4]}`];
      if (count !== n) return null;
      const pose = listed([0, 0, 0, 0, 0, 0]);
      return ["camera.cameramodel", [
        "{", `    'lensmodel':  'LENSMODEL_${name}',`, `    'intrinsics': ${listed([...intrinsics, ...distortion])},`,
        `    'rt_cam_ref': ${pose},`, `    'extrinsics': ${pose},`, `    'imagersize': [ ${size[1]}, ${size[0]},],`, "}", "",
      ].join("\n")];
    },
  };

  const file = (format) => FORMATS[format](state, coefficientNames(state.model, state.distortion.length) ?? []);

  function offerFormats() {
    const names = Object.keys(FORMATS).filter((name) => file(name)), shown = [...$("format").options].map((o) => o.value);
    if (names.join() !== shown.join()) $("format").replaceChildren(...names.map((name) => new Option(name, name)));
  }

  // -- real lenses

  let collection = null;
  async function readCollection() {
    const inflate = async (text) => {
      const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
      return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"))).arrayBuffer();
    };
    const { count, widths, steps, names, numbers } = DATA.lenses;
    const [text, planes] = [new TextDecoder().decode(await inflate(names)).split("\0"), new Uint8Array(await inflate(numbers))];
    const columns = [];
    let offset = 0;
    for (const width of widths) {
      const column = new Float64Array(count);
      for (let i = 0; i < width; i++, offset += count)
        for (let j = 0; j < count; j++) column[j] += planes[offset + j] * 256 ** i;
      columns.push(column.map((code) => (code % 2 ? -(code + 1) / 2 : code / 2)));
    }
    collection = Array.from({ length: count }, (_, i) => {
      const parts = [0, 1, 2, 3, 4, 5].map((n) => text[n * count + i]), [width, height] = [Number(parts[4]), Number(parts[5])];
      const name = parts.slice(0, 4).filter(Boolean).join(" ");
      return { name, words: `${name} ${width}x${height}`.toLowerCase(), index: i, size: [height, width] };
    });
    collection.lens = ({ index, size: [height, width] }) => {
      const [f, fy, cx, cy, ...k] = columns.map((column) => column[index]), fx = f * steps[0];
      const corner = Math.hypot(width, height) / 2 / fx;
      return {
        model: "kannala_brandt",
        intrinsics: [fx, fx + fy * steps[0], width / 2 + cx * steps[0], height / 2 + cy * steps[0]],
        distortion: k.map((c, i) => Number(((c * steps[1]) / (fx * corner ** (2 * i + 3))).toPrecision(9))),
        image_size: [height, width],
      };
    };
  }

  async function search() {
    const words = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
    if (!words.length) return $("found").replaceChildren();
    if (!collection) {
      try {
        await readCollection();
      } catch {
        return tell("This browser cannot unpack the list of lenses; a newer one can.", true);
      }
    }
    const found = collection.filter((lens) => words.every((word) => lens.words.includes(word)));
    found.sort((a, b) => a.words.length - b.words.length);
    $("found").replaceChildren(
      ...found.slice(0, 40).map((lens) => {
        const item = document.createElement("li"), button = document.createElement("button");
        button.type = "button";
        button.textContent = `${lens.name}, ${lens.size[1]} x ${lens.size[0]}`;
        button.addEventListener("click", () => {
          tell(`${lens.name}.`);
          choose(collection.lens(lens), lens.name);
        });
        item.append(button);
        return item;
      }),
    );
    if (!found.length) tell(`No lens has all of these words: ${words.join(" ")}.`, true);
    else tell(`${found.length} of ${collection.length} lenses${found.length > 40 ? "; the first 40 are listed" : ""}.`);
    return undefined;
  }

  // -- frames

  function frame() {
    if (waiting.lens) {
      trouble = "";
      try {
        camera = new Formulas.Camera(state.model, state.intrinsics, state.distortion);
        drawSource();
        renderer.load();
        makeTarget();
        drawCurve();
        offerFormats();
        ask("view");
        const reach = camera.reach(0), end = onCircle(reach * (1 - 1e-6), 0);
        if (reach < 1 && !(end && end[0] - state.intrinsics[2] > 0.05 * state.size[1]))
          tell(`With these coefficients the lens folds ${(reach / RADIAN).toFixed(2)}° from its axis: nearly no pixel has a ray.`, true);
      } catch (error) {
        trouble = error.message;
        if (!camera) {
          // of the address; no page is to be blank
          choose({ model: state.model, ...DATA.models[state.model] });
          frame();
          return tell(`${error.message} The page shows its own ${DATA.models[state.model].class}.`, true);
        }
        tell(trouble, true);
        ask("view");
      }
      waiting.lens = false;
    }
    if (waiting.view && camera) {
      makeTarget();
      drawLeft();
      drawRight();
      const { model, projection, fov, picture } = state;
      $("model").value = model;
      $("projection").value = projection;
      $("picture").value = picture;
      $("fov").disabled = !(projection in PROJECTIONS);
      $("fov").max = PROJECTIONS[projection]?.[2] ?? 360;
      $("fov").value = fov;
      $("fov-text").textContent = projection in PROJECTIONS ? `${Math.round(fov)}°` : "as calibrated";
      $("python").textContent = python();
      $("command").textContent = command();
      keepAddress();
    }
    waiting.view = false;
    return undefined;
  }

  function guarded() {
    asked = 0;
    try {
      frame();
    } catch (error) {
      waiting.lens = waiting.view = false;
      tell(`This cannot be drawn: ${error.message}`, true);
    }
  }

  function turn(yaw, pitch) {
    state.yaw = Math.round((((state.yaw + yaw + 540) % 360) - 180) * 10) / 10;
    state.pitch = Math.round(Math.min(90, Math.max(-90, state.pitch + pitch)) * 10) / 10;
    ask("view");
  }

  function widen(factor) {
    if (!(state.projection in PROJECTIONS)) return;
    state.fov = Math.round(Math.min(Math.max(state.fov * factor, 5), PROJECTIONS[state.projection][2]) * 10) / 10;
    ask("view");
  }

  function moveLabels(du, dv) {
    if (state.picture !== "photograph") return;
    labels.points = labels.points.map(([u, v]) => [u + du, v + dv]);
    labels.box = labels.box.map((w, i) => w + (i % 2 ? dv : du));
    ask("view");
  }

  function dragging(canvas, moved) {
    let last = null;
    canvas.addEventListener("pointerdown", (event) => {
      last = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return;
      moved((event.clientX - last[0]) / canvas.clientWidth, (event.clientY - last[1]) / canvas.clientWidth);
      last = [event.clientX, event.clientY];
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => (last = null));
  }

  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

  function listen() {
    const onChange = (id, name, action) => $(id).addEventListener(name, action);
    onChange("model", "change", () => {
      tell("");
      const key = $("model").value;
      choose({ model: key, ...DATA.models[key] });
    });
    onChange("picture", "change", () => {
      state.picture = $("picture").value;
      if (state.picture === "photograph") fitToPhotograph();
      makeSliders();
      ask("lens");
    });
    onChange("projection", "change", () => {
      state.projection = $("projection").value;
      ask("view");
    });
    onChange("fov", "input", () => {
      state.fov = Number($("fov").value);
      ask("view");
    });
    onChange("home", "click", () => turn(-state.yaw, -state.pitch));
    onChange("reset", "click", () => {
      tell("");
      choose(first, first.title);
    });
    onChange("search", "input", search);
    onChange("file", "change", () => {
      const [chosen] = $("file").files;
      if (chosen) takePhotograph(chosen, chosen.name);
      $("file").value = "";
    });
    onChange("download", "click", () => {
      const [name, text] = file($("format").value), link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([text], { type: "text/plain" }));
      link.download = name;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    });
    for (const id of ["python", "command"])
      onChange(`copy-${id}`, "click", async () => {
        try {
          await navigator.clipboard.writeText($(id).textContent);
          tell("Copied.");
        } catch {
          getSelection().selectAllChildren($(id));
          tell("The lines are selected; the keys for copying copy them.");
        }
      });
    dragging($("right"), (across, down) => {
      const degrees = state.projection in PROJECTIONS ? Math.min(state.fov, 180) : 100;
      turn(-across * degrees, down * degrees);
    });
    dragging($("left"), (across, down) => moveLabels(across * state.size[1], down * state.size[1]));
    onChange("right", "keydown", (event) => {
      const [across, down] = ARROWS[event.key] ?? [0, 0];
      if (across || down) turn(5 * across, -5 * down);
      else if (event.key === "+" || event.key === "=") widen(1 / 1.1);
      else if (event.key === "-") widen(1.1);
      else if (event.key === "0") turn(-state.yaw, -state.pitch);
      else return;
      event.preventDefault();
    });
    onChange("left", "keydown", (event) => {
      const [across, down] = ARROWS[event.key] ?? [0, 0];
      if (!across && !down) return;
      moveLabels((across * state.size[1]) / 100, (down * state.size[1]) / 100);
      event.preventDefault();
    });
    onChange("right", "wheel", (event) => {
      if (document.activeElement !== $("right")) return; // else the page scrolls
      widen(event.deltaY > 0 ? 1.05 : 1 / 1.05);
      event.preventDefault();
    });
    document.addEventListener("dragover", (event) => {
      event.preventDefault();
      document.body.classList.add("dropping");
    });
    document.addEventListener("dragleave", () => document.body.classList.remove("dropping"));
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      document.body.classList.remove("dropping");
      const [dropped] = event.dataTransfer.files;
      if (dropped) takePhotograph(dropped, dropped.name);
      else tell("What was dropped is no file.", true);
    });
    addEventListener("resize", () => (ask("lens")));
    addEventListener("hashchange", readAddress);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => (ask("lens")));
  }

  async function begin() {
    const own = DATA.camera; // a splined one may have a grid that no preset has
    if (own) DATA.models[own.model] ??= { ...own, counts: [own.distortion.length] };
    const keys = Object.keys(DATA.models).filter((key) => Formulas.MODELS.includes(key.split(":")[0]));
    const options = () => keys.map((key) => new Option(DATA.models[key].class, key));
    $("model").replaceChildren(...options());
    $("models").replaceChildren(...options());
    makeRenderer(new URLSearchParams(location.hash.slice(1)).get("draw"));
    listen();
    choose(DATA.camera ?? { model: "kannala_brandt", ...DATA.models.kannala_brandt });
    readAddress();
    if (DATA.photograph) {
      frame();
      const told = [$("message").textContent, $("message").className !== ""]; // of what the address asks for
      const bytes = Uint8Array.from(atob(DATA.photograph.split(",")[1]), (c) => c.charCodeAt(0));
      await takePhotograph(new Blob([bytes], { type: "image/jpeg" }), "the photograph", DATA.camera.image_size);
      tell(...told);
    }
  }

  begin().catch((error) => tell(`This page cannot begin: ${error.message}`, true));
  return { state, frame, ask, cells, file, FORMATS, takePhotograph, renderer: () => renderer, viewSize, labels: () => labels };
})();

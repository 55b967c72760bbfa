// The 3D view: objects, path and rays on a canvas, from a view point that the reader moves.
{
  const data = JSON.parse(document.getElementById("scene-data")?.textContent ?? "null");
  const canvas = document.getElementById("scene-canvas");
  if (data && canvas) {
    const floats = text => new Float32Array(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
    const rays = floats(data.rays), path = floats(data.path), truePath = floats(data.true_path);
    const objects = data.objects, byId = new Map(objects.map(o => [o.id, o]));
    const pen = canvas.getContext("2d"), note = document.getElementById("scene-note"), box = canvas.parentElement;
    const shows = name => document.getElementById("scene-" + name).checked;
    const middle = data.low.map((x, i) => (x + data.high[i]) / 2);
    const size = Math.max(1, Math.hypot(...data.high.map((x, i) => x - data.low[i])));
    const start = {azimuth: -1.9, height: 0.72};
    let view = {...start, distance: size, target: [...middle]}, fitted = true;
    let chosen = null, hovered = null, asked = false, theme = {};

    // Project a point. Returns x and y in CSS px, and the depth in m, which is negative behind the view point.
    let frame = {};
    const place = () => {
      const [sa, ca, sh, ch] = [Math.sin(view.azimuth), Math.cos(view.azimuth), Math.sin(view.height), Math.cos(view.height)];
      const back = [ca * ch, sa * ch, sh], right = [-sa, ca, 0], up = [-ca * sh, -sa * sh, ch];
      const eye = view.target.map((x, i) => x + view.distance * back[i]);
      const [w, h] = [canvas.clientWidth, canvas.clientHeight];
      frame = {back, right, up, eye, w, h, focal: 1.15 * Math.min(w, 1.4 * h)};
    };
    const project = (x, y, z) => {
      const {back, right, up, eye, w, h, focal} = frame, a = x - eye[0], b = y - eye[1], c = z - eye[2];
      const depth = -(a * back[0] + b * back[1] + c * back[2]), scale = focal / Math.max(depth, 1e-3);
      return [w / 2 + scale * (a * right[0] + b * right[1] + c * right[2]),
              h / 2 - scale * (a * up[0] + b * up[1] + c * up[2]), depth];
    };
    const near = () => 0.02 * view.distance;
    // Look from a direction, so far away that objects and path fill the view. Those outside low and high do not count.
    const inside = p => p.every((x, i) => x >= data.low[i] - 1e-3 && x <= data.high[i] + 1e-3);
    // One of the eight corners of the upright box around a body. Three bits say on which side of the centre it is.
    const corner = (o, bits) => o.at.map((x, i) => o.body.reduce((sum, a, k) => sum + (bits >> k & 1 ? a[i] : -a[i]), x));
    const seenOf = o => o.body.length ? [0, 1, 2, 3, 4, 5, 6, 7].map(bits => corner(o, bits)) : [o.at];
    const way = Array.from({length: path.length / 3}, (_, i) => [...path.subarray(3 * i, 3 * i + 3)]);
    const whole = [...objects.filter(o => inside(o.at)).flatMap(seenOf), ...way.filter(inside)];
    if (!whole.length) whole.push(data.low, data.high);
    const fit = ({azimuth, height}) => {
      view = {azimuth, height, distance: 2 * size, target: [...middle]}; fitted = true;
      for (let round = 0; round < 5; round++) {
        place();
        const seen = whole.map(p => project(...p)), xs = seen.map(p => p[0]), ys = seen.map(p => p[1]);
        const [left, right, top, bottom] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
        const metres = view.distance / frame.focal;
        const dx = metres * ((left + right - frame.w) / 2), dy = -metres * ((top + bottom - frame.h) / 2);
        view.target = view.target.map((x, i) => x + dx * frame.right[i] + dy * frame.up[i]);
        const filled = Math.max((right - left) / Math.max(frame.w - 130, 60), (bottom - top) / Math.max(frame.h - 70, 60));
        view.distance = Math.max(view.distance * filled, 0.2);
      }
    };

    const segment = (p, q) => {
      if (p[2] < near() || q[2] < near()) return;
      pen.moveTo(p[0], p[1]); pen.lineTo(q[0], q[1]);
    };
    const line = (points, colour, width, dashes = []) => {
      pen.beginPath(); pen.strokeStyle = colour; pen.lineWidth = width; pen.setLineDash(dashes);
      let last = null;
      for (let i = 0; i + 2 < points.length; i += 3) {
        const p = project(points[i], points[i + 1], points[i + 2]);
        if (last) segment(last, p);
        last = p;
      }
      pen.stroke(); pen.setLineDash([]);
    };
    const drawFloor = () => {
      // A grid below everything. Returns the distance of its lines, m, which is a round number.
      const step = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500].find(s => size / s < 16) ?? size / 10;
      const low = data.low.map(x => Math.floor(x / step - 1) * step), high = data.high.map(x => Math.ceil(x / step + 1) * step);
      const z = data.low[2];
      pen.beginPath(); pen.strokeStyle = theme.line; pen.lineWidth = 1;
      for (let x = low[0]; x <= high[0] + 1e-6; x += step) segment(project(x, low[1], z), project(x, high[1], z));
      for (let y = low[1]; y <= high[1] + 1e-6; y += step) segment(project(low[0], y, z), project(high[0], y, z));
      pen.stroke();
      return step;
    };
    const drawRays = () => {
      const focus = chosen ?? hovered;
      const stroke = (wanted, colour, width, alpha) => {
        pen.beginPath(); pen.strokeStyle = colour; pen.lineWidth = width; pen.globalAlpha = alpha;
        for (let i = 0; i < data.of.length; i++) {
          if (!wanted(i)) continue;
          segment(project(...rays.subarray(6 * i, 6 * i + 3)), project(...rays.subarray(6 * i + 3, 6 * i + 6)));
        }
        pen.stroke(); pen.globalAlpha = 1;
      };
      const many = Math.min(0.5, Math.max(0.12, 120 / Math.max(data.used, 1)));
      stroke(i => i < data.used && data.of[i] !== focus, theme.used, 1, focus === null ? many : many / 3);
      stroke(i => i >= data.used && data.of[i] !== focus, theme.rejected, 1, focus === null ? 0.4 : 0.1);
      if (focus === null) return;
      stroke(i => i < data.used && data.of[i] === focus, theme.used, 1.2, 0.85);
      stroke(i => i >= data.used && data.of[i] === focus, theme.rejected, 1.2, 0.9);
    };
    // In dark mode, the colours are mixed with white, because they were chosen for white paper.
    const shade = hex => {
      const parts = [1, 3, 5].map(i => parseInt(hex.slice(i, i + 2), 16));
      return `rgb(${parts.map(x => Math.round(theme.dark ? x + 0.45 * (255 - x) : x)).join(" ")})`;
    };
    // The outline of an ellipsoid, by the derivative of the projection at its centre.
    const outline = (o, axes, p, fill, width) => {
      const scale = frame.focal / p[2], {right, up, back} = frame;
      const dx = (p[0] - frame.w / 2) / frame.focal, dy = (p[1] - frame.h / 2) / frame.focal;
      const flat = axes.map(a => {
        const on = v => a[0] * v[0] + a[1] * v[1] + a[2] * v[2];
        return [scale * (on(right) + dx * on(back)), scale * (-on(up) + dy * on(back))];
      });
      let [xx, xy, yy] = [0, 0, 0];
      for (const [x, y] of flat) { xx += x * x; xy += x * y; yy += y * y; }
      const mean = (xx + yy) / 2, off = Math.hypot((xx - yy) / 2, xy);
      pen.beginPath();
      pen.ellipse(p[0], p[1], Math.sqrt(mean + off), Math.sqrt(Math.max(mean - off, 0)), Math.atan2(2 * xy, xx - yy) / 2, 0, 7);
      pen.globalAlpha = fill; pen.fillStyle = shade(o.colour); pen.fill();
      pen.globalAlpha = 0.8; pen.strokeStyle = shade(o.colour); pen.lineWidth = width; pen.stroke(); pen.globalAlpha = 1;
    };
    // A cuboid by its twelve edges.
    const traceCuboid = o => {
      const at = bits => project(...corner(o, bits));
      for (let bits = 0; bits < 8; bits++) for (const bit of [1, 2, 4]) if (!(bits & bit)) segment(at(bits), at(bits | bit));
    };
    // An upright cylinder by its two rims, and the two lines where planes through the view point touch its side.
    const traceCylinder = o => {
      const [along, across, up] = o.body, step = Math.PI / 24;
      const rim = (turn, end) => {
        const [cos, sin] = [Math.cos(turn), Math.sin(turn)];
        return project(...o.at.map((x, i) => x + cos * along[i] + sin * across[i] + end * up[i]));
      };
      for (const end of [-1, 1]) for (let k = 0; k < 48; k++) segment(rim(k * step, end), rim((k + 1) * step, end));
      // The view point in units of the half axes, in which the section is the unit circle.
      const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
      const to = frame.eye.map((x, i) => x - o.at[i]), [x, y] = [along, across].map(a => dot(a, to) / dot(a, a));
      const away = Math.hypot(x, y);
      if (!(away > 1)) return;
      for (const side of [-1, 1]) {
        const turn = Math.atan2(y, x) + side * Math.acos(1 / away);
        segment(rim(turn, -1), rim(turn, 1));
      }
    };
    // Cuboids and cylinders by their edges, an ellipsoid by its outline.
    const drawBody = (o, p) => {
      if (o.shape === "ellipsoid") return outline(o, o.body, p, 0, 2);
      pen.beginPath(); pen.strokeStyle = shade(o.colour); pen.lineWidth = 2;
      if (o.shape === "cuboid") traceCuboid(o); else traceCylinder(o);
      pen.stroke();
    };
    const drawObjects = () => {
      const seen = objects.map(o => ({o, p: project(...o.at)})).filter(({p}) => p[2] > near()).sort((a, b) => b.p[2] - a.p[2]);
      if (shows("ellipsoids")) for (const {o, p} of seen) if (o.ok && o.axes.length) outline(o, o.axes, p, 0.18, 1);
      if (shows("bodies")) for (const {o, p} of seen) if (o.body.length) drawBody(o, p);
      for (const {o, p} of seen) {
        const big = o.id === chosen || o.id === hovered;
        // A stem down to the floor shows the height and the position.
        pen.beginPath(); pen.strokeStyle = theme.faint; pen.globalAlpha = 0.5; pen.lineWidth = 1;
        segment(p, project(o.at[0], o.at[1], data.low[2])); pen.stroke(); pen.globalAlpha = 1;
        pen.beginPath(); pen.arc(p[0], p[1], big ? 7 : 5, 0, 7);
        pen.fillStyle = o.ok ? shade(o.colour) : theme.page; pen.fill();
        pen.strokeStyle = o.ok ? theme.page : shade(o.colour); pen.lineWidth = 1.5; pen.stroke();
      }
      pen.strokeStyle = theme.text; pen.lineWidth = 1.4;
      pen.beginPath();
      for (const t of data.truth) {
        const [x, y, depth] = project(...t);
        if (depth < near()) continue;
        pen.moveTo(x - 5, y); pen.lineTo(x + 5, y); pen.moveTo(x, y - 5); pen.lineTo(x, y + 5);
      }
      pen.stroke();
      return seen;
    };
    const drawLabels = seen => {
      // The chosen object and the one under the pointer are named first, then the others from near to far. A name of the
      // others is left out if it would cover another name.
      const taken = [], first = ({o}) => (o.id === chosen || o.id === hovered ? 0 : 1);
      pen.font = "12px system-ui, sans-serif"; pen.textBaseline = "middle"; pen.lineJoin = "round";
      for (const {o, p} of [...seen].sort((a, b) => first(a) - first(b) || a.p[2] - b.p[2])) {
        const width = pen.measureText(o.name).width;
        const spots = [[9, 0], [-9 - width, 0], [-width / 2, -15], [-width / 2, 15]];
        const free = spots.map(([dx, dy]) => [p[0] + dx - 2, p[1] + dy - 8, p[0] + dx + width + 2, p[1] + dy + 8])
          .filter(a => a[0] >= 0 && a[2] <= frame.w)
          .find(a => !taken.some(b => a[0] < b[2] && a[2] > b[0] && a[1] < b[3] && a[3] > b[1]));
        if (!free && first({o})) continue;
        const at = free ?? [p[0] + 7, p[1] - 8, p[0] + 11 + width, p[1] + 8];
        taken.push(at);
        pen.strokeStyle = theme.page; pen.lineWidth = 3.5; pen.strokeText(o.name, at[0] + 2, at[1] + 8);
        pen.fillStyle = shade(o.colour); pen.fillText(o.name, at[0] + 2, at[1] + 8);
      }
    };
    const drawAxes = step => {
      const origin = [34, frame.h - 34];
      pen.font = "11px system-ui, sans-serif"; pen.textBaseline = "middle";
      for (const [name, a] of data.axes) {
        const x = 22 * (a[0] * frame.right[0] + a[1] * frame.right[1] + a[2] * frame.right[2]);
        const y = -22 * (a[0] * frame.up[0] + a[1] * frame.up[1] + a[2] * frame.up[2]);
        pen.beginPath(); pen.strokeStyle = pen.fillStyle = theme.faint; pen.lineWidth = 1.5;
        pen.moveTo(...origin); pen.lineTo(origin[0] + x, origin[1] + y); pen.stroke();
        pen.fillText(name, origin[0] + 1.35 * x - 3, origin[1] + 1.35 * y);
      }
      pen.fillStyle = theme.faint; pen.textAlign = "right";
      pen.fillText(`grid ${+step.toFixed(2)} m`, frame.w - 10, frame.h - 12); pen.textAlign = "left";
    };
    const draw = () => {
      asked = false;
      const ratio = devicePixelRatio || 1, style = getComputedStyle(box);
      for (const name of ["text", "faint", "page", "line", "used", "rejected"]) theme[name] = style.getPropertyValue("--" + name).trim();
      theme.dark = matchMedia("(prefers-color-scheme: dark)").matches;
      const [w, h] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
      if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      if (fitted) fit(view);
      place();
      pen.clearRect(0, 0, frame.w, frame.h);
      const step = drawFloor();
      if (shows("rays")) drawRays();
      line(truePath, theme.faint, 1, [4, 4]);
      line(path, theme.text, 1.6);
      const seen = drawObjects();
      if (shows("labels")) drawLabels(seen);
      drawAxes(step);
    };
    const redraw = () => { if (!asked) { asked = true; requestAnimationFrame(draw); } };

    const tell = () => {
      const o = byId.get(chosen);
      note.textContent = "";
      if (!o) { note.textContent = note.dataset.hint; return; }
      const link = document.createElement("a");
      link.href = "#object-" + o.id; link.textContent = o.name;
      note.append(link, ` has ${data.of.filter(id => id === o.id).length} of the rays that are drawn.`);
    };
    const choose = id => { chosen = id; tell(); redraw(); };
    const clamp = () => {
      view.height = Math.min(1.5707, Math.max(-1.2, view.height));
      view.distance = Math.min(20 * size, Math.max(0.02 * size, view.distance));
    };
    const turn = (dx, dy) => { fitted = false; view.azimuth -= 0.008 * dx; view.height += 0.008 * dy; clamp(); redraw(); };
    const shift = (dx, dy) => {
      const metres = view.distance / frame.focal;
      fitted = false;
      view.target = view.target.map((x, i) => x - metres * (dx * frame.right[i] - dy * frame.up[i]));
      redraw();
    };
    const zoom = factor => { fitted = false; view.distance *= factor; clamp(); redraw(); };
    const pick = (x, y) => {
      let best = null, least = 14;
      for (const o of objects) {
        const p = project(...o.at), away = Math.hypot(p[0] - x, p[1] - y);
        if (p[2] > near() && away < least) { best = o.id; least = away; }
      }
      return best;
    };

    const held = new Map();
    let moved = 0;
    canvas.addEventListener("pointerdown", e => {
      canvas.setPointerCapture(e.pointerId); held.set(e.pointerId, [e.offsetX, e.offsetY]); moved = 0;
    });
    canvas.addEventListener("pointermove", e => {
      const before = held.get(e.pointerId);
      if (!before) {
        const at = pick(e.offsetX, e.offsetY);
        if (at !== hovered) { hovered = at; canvas.style.cursor = at === null ? "grab" : "pointer"; redraw(); }
        return;
      }
      const [dx, dy] = [e.offsetX - before[0], e.offsetY - before[1]];
      const other = [...held].find(([id]) => id !== e.pointerId)?.[1];
      moved += Math.hypot(dx, dy);
      if (other) {
        const apart = p => Math.hypot(p[0] - other[0], p[1] - other[1]);
        zoom(apart(before) / Math.max(apart([e.offsetX, e.offsetY]), 1)); shift(dx / 2, dy / 2);
      } else if (e.shiftKey || e.buttons === 2) shift(dx, dy);
      else turn(dx, e.pointerType === "touch" ? 0 : dy);
      held.set(e.pointerId, [e.offsetX, e.offsetY]);
    });
    const release = e => {
      if (held.delete(e.pointerId) && e.type === "pointerup" && moved < 4) choose(pick(e.offsetX, e.offsetY));
    };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("contextmenu", e => e.preventDefault());
    // The wheel scrolls the page until the reader has clicked into the view, or holds Ctrl.
    canvas.addEventListener("wheel", e => {
      if (document.activeElement !== canvas && !e.ctrlKey) return;
      e.preventDefault(); zoom(Math.exp(0.0012 * e.deltaY));
    }, {passive: false});
    canvas.addEventListener("keydown", e => {
      const turns = {ArrowLeft: [-24, 0], ArrowRight: [24, 0], ArrowUp: [0, 24], ArrowDown: [0, -24]};
      if (turns[e.key]) turn(...turns[e.key]);
      else if (e.key === "+" || e.key === "=") zoom(0.85);
      else if (e.key === "-") zoom(1 / 0.85);
      else if (e.key === "Escape") choose(null);
      else return;
      e.preventDefault();
    });
    const looks = {above: [-Math.PI / 2, 1.5707], side: [-Math.PI / 2, 0.06], start: [start.azimuth, start.height]};
    for (const button of document.querySelectorAll("[data-look]")) button.addEventListener("click", () => {
      const [azimuth, height] = looks[button.dataset.look];
      view = {...view, azimuth, height}; fitted = true; redraw();
    });
    for (const button of document.querySelectorAll("[data-zoom]")) button.addEventListener("click", () => zoom(+button.dataset.zoom));
    for (const name of ["rays", "labels", "ellipsoids", "bodies"]) document.getElementById("scene-" + name).addEventListener("change", redraw);
    for (const link of document.querySelectorAll("[data-show]")) link.addEventListener("click", () => {
      view = {...view, ...start}; fitted = true; choose(+link.dataset.show);
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
    new ResizeObserver(redraw).observe(canvas);
    tell(); redraw();
  }
}

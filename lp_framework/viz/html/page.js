"use strict";
// Tables that sort, plots that are drawn when they come into view, and pairs whose trajectories play along a slider.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const DEGREES = 180 / Math.PI;
  const RELIEF = "Cividis"; // as in the figures: from dark valleys to light heights
  const HALF_VIEW = 49.1 / 2 / DEGREES; // half of the field of view

  // ------------------------------------------------------------ tables

  for (const table of document.querySelectorAll("table[data-sorts]")) {
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, column) =>
      head.firstElementChild.addEventListener("click", () => {
        // Numbers begin with the largest, words with the first.
        const first = head.classList.contains("number") ? "descending" : "ascending";
        const other = first === "ascending" ? "descending" : "ascending";
        const order = head.getAttribute("aria-sort") === first ? other : first;
        for (const each of heads) each.setAttribute("aria-sort", each === head ? order : "none");
        sortRows(table.tBodies[0], column, order === "ascending" ? 1 : -1);
      }),
    );
  }

  function sortRows(body, column, sign) {
    const keys = new Map([...body.rows].map((row) => [row, sortKey(row.cells[column])]));
    const compare = (a, b) => {
      if (a === null || b === null) return (a === null) - (b === null); // what has no value is last either way
      return sign * (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b)));
    };
    body.append(...[...body.rows].sort((a, b) => compare(keys.get(a), keys.get(b))));
  }

  function sortKey(cell) {
    const value = cell.dataset.value ?? cell.textContent.trim();
    if (value === "") return null;
    return Number.isFinite(Number(value)) ? Number(value) : value;
  }

  // ------------------------------------------------------------ runs of a set

  function openRun() {
    const run = location.hash && document.getElementById(location.hash.slice(1));
    if (run instanceof HTMLDetailsElement) {
      run.open = true;
      run.scrollIntoView();
    }
  }
  addEventListener("hashchange", openRun);
  openRun();

  // ------------------------------------------------------------ plots

  let library = null; // the promise of plotly.js, which is unpacked once

  function plotly() {
    library ??= (async () => {
      const packed = Uint8Array.from(atob(document.getElementById("plotly").textContent), (c) => c.charCodeAt(0));
      const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
      const script = document.createElement("script");
      script.textContent = await new Response(stream).text();
      document.head.append(script);
      return window.Plotly;
    })();
    return library;
  }

  const drawn = new Map(); // element: a function that makes its figure anew, in the colours of the moment

  async function show(element, figure) {
    drawn.set(element, figure);
    try {
      const Plotly = await plotly();
      const { traces, layout } = figure();
      element.classList.add("drawn");
      await Plotly.react(element, traces, { ...look(), ...layout }, {
        displaylogo: false, responsive: true, scrollZoom: false, displayModeBar: false,
      });
    } catch (error) {
      element.classList.remove("drawn");
      element.classList.add("failed");
      element.dataset.failed = `This browser cannot draw the plot (${error.message}).`;
    }
  }

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const [element, figure] of drawn) show(element, figure);
  });

  const FIGURES = {
    errors: (value) => errorsFigure(value),
    curves: (value) => curvesFigure(value),
    scene: (value) => camerasFigure(value),
  };
  const comesIntoView = new IntersectionObserver(
    (entries) => {
      for (const { target, isIntersecting } of entries) {
        if (!isIntersecting) continue;
        comesIntoView.unobserve(target);
        const value = data[Number(target.dataset.of)];
        if (target.classList.contains("pairs")) startViewer(target, value);
        else FIGURES[target.dataset.plot](value).then((figure) => show(target, figure));
      }
    },
    { rootMargin: "200px" },
  );
  for (const element of document.querySelectorAll("[data-of]")) comesIntoView.observe(element);

  const narrow = matchMedia("(max-width: 700px)");

  function colour(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  }

  function look() {
    return {
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", size: 12, color: colour("ink") },
      margin: { l: 54, r: 12, t: 10, b: 44 },
      hovermode: "closest",
      hoverlabel: { bgcolor: colour("raised"), bordercolor: colour("line"), font: { color: colour("ink") } },
      showlegend: false,
      uirevision: "kept", // zoom and viewpoint stay when colours change
    };
  }

  function axis(title, more = {}) {
    const lines = { gridcolor: colour("line"), linecolor: colour("line"), zerolinecolor: colour("line") };
    return { title: { text: title, font: { color: colour("muted") } }, ...lines, ...more };
  }

  // ------------------------------------------------------------ errors and losses

  async function errorsFigure(curves) {
    const ticks = [0, 5, 15, 30, 60, 90, 120, 180];
    return () => ({
      traces: curves.map(({ name, label, error, share }) => ({
        x: error.map(Math.sqrt), y: share, name: label, mode: "lines", customdata: error,
        line: { color: colour(name), width: 2.5, shape: "hv" },
        hovertemplate: "%{y:.1%} of pairs within %{customdata:.1f}°<extra>%{fullData.name}</extra>",
      })),
      layout: {
        xaxis: axis("rotation error (square-root scale)", {
          tickvals: ticks.map(Math.sqrt), ticktext: ticks.map((each) => `${each}°`), range: [0, Math.sqrt(180)],
        }),
        yaxis: axis("share of pairs within the error", { range: [0, 1.01], tickformat: ".0%" }),
        shapes: [5, 15, 30].map((each) => ({
          type: "line", x0: Math.sqrt(each), x1: Math.sqrt(each), y0: 0, y1: 1, yref: "paper",
          line: { color: colour("muted"), width: 1, dash: "dot" },
        })),
        showlegend: true,
        legend: { x: 0.99, xanchor: "right", y: 0.03, yanchor: "bottom", bgcolor: colour("surface"), bordercolor: colour("line"), borderwidth: 1 },
        margin: { l: 54, r: 16, t: 10, b: 44 },
      },
    });
  }

  const LOSSES = ["reference", "answer", "unlabelled", "continuous"]; // colours, by place

  async function curvesFigure({ losses, rate }) {
    return () => {
      const traces = losses.flatMap(({ label, step, value, mean }, place) => {
        const line = { color: colour(LOSSES[place % LOSSES.length]), width: 2 };
        const main = { x: step, y: mean ?? value, name: label, mode: step.length > 30 ? "lines" : "lines+markers", line };
        const pale = { x: step, y: value, mode: "lines", line: { ...line, width: 1 }, opacity: 0.3, hoverinfo: "skip", showlegend: false };
        return mean === null ? [main] : [pale, main];
      });
      if (rate) traces.push({ x: rate.step, y: rate.value, name: "learning rate", yaxis: "y2", mode: "lines", line: { color: colour("ink"), width: 1.5 } });
      return {
        traces,
        layout: {
          xaxis: axis("training step", { anchor: rate ? "y2" : "y" }),
          yaxis: axis("loss (log scale)", { type: "log", domain: [rate ? 0.32 : 0, 1], dtick: "D2", tickformat: "~g" }),
          yaxis2: axis("rate", { domain: [0, 0.22], rangemode: "tozero", nticks: 3, exponentformat: "e" }),
          showlegend: true,
          legend: { x: 0.99, xanchor: "right", y: 0.99, yanchor: "top", bgcolor: colour("surface"), bordercolor: colour("line"), borderwidth: 1 },
          margin: { l: 64, r: 16, t: 10, b: 44 },
        },
      };
    };
  }

  // ------------------------------------------------------------ cameras

  const add = (a, b, share = 1) => a.map((each, place) => each + share * b[place]);
  // Ours has +Y up, plotly +Z.
  const standing = ([x, y, z]) => [x, -z, y];

  function camera([latitude, longitude, radius]) {
    const [sine, cosine] = [Math.sin(latitude), Math.cos(latitude)];
    const back = standing([cosine * Math.sin(longitude), sine, cosine * Math.cos(longitude)]);
    const right = standing([Math.cos(longitude), 0, -Math.sin(longitude)]);
    const up = standing([-sine * Math.sin(longitude), cosine, -sine * Math.cos(longitude)]);
    return { centre: back.map((each) => radius * each), back, right, up };
  }

  // A point of what a camera sees at a distance; across and along go from -1 to 1.
  function inView({ centre, back, right, up }, distance, across, along) {
    const half = distance * Math.tan(HALF_VIEW);
    return add(add(add(centre, back, -distance), right, half * across), up, half * along);
  }

  function lines(paths, more) {
    const points = paths.flatMap((path) => [...path, [null, null, null]]);
    const [x, y, z] = [0, 1, 2].map((place) => points.map((point) => point[place]));
    return { type: "scatter3d", mode: "lines", x, y, z, hoverinfo: "skip", ...more };
  }

  function dots(points, more) {
    const [x, y, z] = [0, 1, 2].map((place) => points.map((point) => point[place]));
    return { type: "scatter3d", mode: "markers", x, y, z, hoverinfo: "skip", ...more };
  }

  function pyramid(pose, distance) {
    const seen = camera(pose);
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([across, along]) => inView(seen, distance, across, along));
    return [[...corners, corners[0]], ...corners.map((corner) => [seen.centre, corner])];
  }

  // The object of an image, without its white ground, on the camera's image plane.
  function imagePlane(pose, distance, pixels) {
    const seen = camera(pose);
    const count = pixels.side;
    const points = [];
    for (let row = 0; row <= count; row++)
      for (let column = 0; column <= count; column++)
        points.push(inView(seen, distance, (2 * column) / count - 1, 1 - (2 * row) / count));
    const [i, j, k, facecolor] = [[], [], [], []];
    pixels.colours.forEach((shade, place) => {
      if (shade === null) return;
      const corner = place + Math.floor(place / count);
      const [right, below] = [corner + 1, corner + count + 1];
      i.push(corner, right); j.push(below, below); k.push(right, below + 1); facecolor.push(shade, shade);
    });
    const [x, y, z] = [0, 1, 2].map((place) => points.map((point) => point[place]));
    return { type: "mesh3d", x, y, z, i, j, k, facecolor, hoverinfo: "skip", lighting: { ambient: 1, diffuse: 0, specular: 0, fresnel: 0 } };
  }

  async function pixelsOf(source, side = 32) {
    const image = new Image();
    image.src = source;
    await image.decode();
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = side;
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0, side, side);
    const values = context.getImageData(0, 0, side, side).data;
    const colours = Array.from({ length: side * side }, (_, place) => {
      const [red, green, blue, alpha] = values.subarray(4 * place, 4 * place + 4);
      return alpha < 128 || Math.min(red, green, blue) > 246 ? null : `rgb(${red},${green},${blue})`;
    });
    return { side, colours };
  }

  // The ground with longitudes, in the object's equator.
  function ground(radius) {
    const at = (angle, share) => standing([share * radius * Math.sin(angle), 0, share * radius * Math.cos(angle)]);
    const turn = Array.from({ length: 73 }, (_, step) => (step * Math.PI) / 36);
    const spokes = Array.from({ length: 12 }, (_, step) => [at((step * Math.PI) / 6, 0.35), at((step * Math.PI) / 6, 1)]);
    const quarters = [0, 1, 2, 3].map((step) => at((step * Math.PI) / 2, 1.12));
    return [
      lines([turn.map((angle) => at(angle, 1)), ...spokes], { line: { color: colour("line"), width: 2 } }),
      { ...dots(quarters), mode: "text", text: ["0°", "90°", "180°", "270°"], textfont: { color: colour("muted"), size: 11 } },
    ];
  }

  // A scene of cameras at most `furthest` from the object, seen from above a longitude.
  function scene(furthest, longitude) {
    const side = (low, high) => ({ visible: false, showspikes: false, range: [low * furthest, high * furthest] });
    const [x, y] = standing([Math.sin(longitude + 0.6), 0, Math.cos(longitude + 0.6)]);
    return {
      margin: { l: 0, r: 0, t: 0, b: 0 },
      scene: {
        xaxis: side(-1.3, 1.3), yaxis: side(-1.3, 1.3), zaxis: side(-1.1, 1.1),
        aspectmode: "manual", aspectratio: { x: 2, y: 2, z: 1.7 }, dragmode: "turntable",
        camera: { eye: { x: 1.9 * x, y: 1.9 * y, z: 1 }, center: { x: 0, y: 0, z: -0.05 } },
      },
    };
  }

  async function camerasFigure({ views }) {
    const pixels = await Promise.all(views.map(({ image }, place) => pixelsOf(image, place === 0 ? 64 : 32)));
    const furthest = Math.max(...views.map(({ pose }) => pose[2]));
    const distance = furthest * (views.length > 5 ? 0.26 : 0.34);
    return () => {
      const shades = views.map((_, place) => colour(place === 0 ? "reference" : "answer"));
      const centres = views.map(({ pose }) => camera(pose).centre);
      return {
        traces: [
          ...ground(furthest * 1.1),
          imagePlane(views[0].pose, views[0].pose[2], pixels[0]),
          ...views.map(({ pose }, place) => imagePlane(pose, distance, pixels[place])),
          ...views.map(({ pose }, place) => lines(pyramid(pose, distance), { line: { color: shades[place], width: 4 } })),
          { ...dots(centres, { marker: { color: shades, size: 5 }, text: views.map(({ label }) => label) }),
            hoverinfo: "text", mode: "markers+text", textposition: "top center", textfont: { color: colour("ink"), size: 12 } },
        ],
        layout: scene(furthest, views[0].pose[1]),
      };
    };
  }

  const MOVES = "moves"; // marks the traces that the slider changes, in the order of their `...Ways`

  // ------------------------------------------------------------ a pair: landscape, map and cameras along its steps

  function startViewer(element, { examples }) {
    const part = (name) => element.querySelector(name);
    const cards = [...element.querySelectorAll(".card")];
    const [map, surface, cameras] = ["map", "surface", "cameras"].map((name) => part(`.plot.${name}`));
    const [slider, output, play, choice] = [".player input", ".player output", ".player button", ".player select"].map(part);
    let shown = null; // the example, its landscape, and images' pixels
    let playing = null;

    cards.forEach((card, place) => card.addEventListener("click", () => choose(place)));
    choice.addEventListener("change", () => { shown.landscape = shown.example.landscapes[choice.selectedIndex]; draw(); });
    slider.addEventListener("input", () => { stop(); step(Number(slider.value)); });
    play.addEventListener("click", () => (playing === null ? start() : stop()));
    choose(0);

    async function choose(place) {
      stop();
      const example = examples[place];
      cards.forEach((card, other) => card.setAttribute("aria-pressed", String(other === place)));
      tell(part(".told"), example);
      const pixels = await Promise.all([...cards[place].querySelectorAll("img")].map((image) => pixelsOf(image.src)));
      shown = { example, pixels, landscape: example.landscapes[0] ?? null, at: 0 };
      choice.replaceChildren(...example.landscapes.map(({ name }) => new Option(name)));
      choice.hidden = example.landscapes.length < 2;
      const steps = example.trajectories === null ? 0 : example.trajectories[0].length - 1;
      for (const each of [slider, output, play]) each.hidden = steps === 0;
      slider.max = String(steps);
      slider.value = String(steps);
      shown.at = steps;
      await draw();
    }

    async function draw() {
      const now = shown;
      part(".surface-figure").hidden = now.landscape === null;
      part(".cameras-figure").classList.toggle("wide", now.landscape === null);
      say();
      await show(map, () => mapFigure(now));
      if (now.landscape !== null) await show(surface, () => surfaceFigure(now));
      await show(cameras, () => pairCamerasFigure(now));
    }

    function say() {
      output.textContent = `step ${shown.at} of ${slider.max}`;
    }

    function step(at) {
      shown.at = at;
      say();
      const updates = [[map, mapWays], [cameras, cameraWays]];
      if (shown.landscape !== null) updates.splice(1, 0, [surface, surfaceWays]);
      for (const [plot, ways] of updates) {
        if (!plot.classList.contains("drawn")) continue;
        const moved = ways(shown);
        const places = plot.data.flatMap(({ meta }, place) => (meta === MOVES ? [place] : []));
        const change = Object.fromEntries(["x", "y", "z"].filter((key) => key in moved[0]).map((key) => [key, moved.map((each) => each[key])]));
        window.Plotly.restyle(plot, change, places);
      }
    }

    function start() {
      const last = Number(slider.max);
      const from = Number(slider.value) >= last ? 0 : Number(slider.value);
      const began = performance.now();
      play.textContent = "Pause";
      const tick = (time) => {
        const at = Math.min(last, from + Math.floor(((time - began) / 6000) * last)); // all of it takes six seconds
        if (at !== Number(slider.value)) { slider.value = String(at); step(at); }
        if (at >= last) stop();
        else playing = requestAnimationFrame(tick);
      };
      slider.value = String(from);
      step(from);
      playing = requestAnimationFrame(tick);
    }

    function stop() {
      if (playing !== null) cancelAnimationFrame(playing);
      playing = null;
      play.textContent = "Play";
    }
  }

  function tell(list, { truth, ends, chosen, rotation_errors: rotation, translation_errors: translation, landscapes, reason }) {
    const number = (value, digits) => (value === null ? "none" : value.toFixed(digits).replace("-", "\u2212"));
    const angle = (value) => number(value === null ? null : value * DEGREES, 1) + (value === null ? "" : "°");
    const turned = (value) => angle(value === null ? null : ((value % (2 * Math.PI)) + 2 * Math.PI) % (2 * Math.PI));
    const pose = ([latitude, longitude, radius]) => `latitude ${angle(latitude)}, longitude ${turned(longitude)}, radius ${number(radius, 2)}`;
    const entries = [
      ["pair", reason],
      ...(truth ? [["true relative pose", pose(truth)]] : []),
      ["answer", `${pose(ends[chosen])}${rotation[chosen] === null ? "" : `: off by ${number(rotation[chosen], 1)}°${translation[chosen] === null ? "" : ` and ${number(translation[chosen], 2)}`}`}`],
      ...landscapes.map(({ name, minima }) => {
        const places = minima.slice(0, 4).map((each) => `${angle(each[0])}, ${turned(each[1])}`).join("; ");
        return [name, minima.length === 1 ? `one valley, at ${places}` : `${minima.length} valleys, the deepest first: ${places}${minima.length > 4 ? "; …" : ""}`];
      }),
    ];
    list.replaceChildren(...entries.flatMap(([key, value]) => {
      const [term, description] = [document.createElement("dt"), document.createElement("dd")];
      term.textContent = key;
      description.textContent = value;
      return [term, description];
    }));
  }

  // The way of every start up to a step; of solvers without trajectories only where they ended.
  function ways({ example, at }) {
    if (example.trajectories === null) return example.ends.map((end) => [end]);
    return example.trajectories.map((path) => path.slice(0, at + 1));
  }

  // Parts of all ways: the other starts' and the answer's, and where both are now. `place` maps a pose to a point.
  function parted(shown, broken, place) {
    const all = ways(shown).map((path) => path.filter((pose) => pose.every((each) => each !== null)));
    const chosen = shown.example.chosen;
    const others = all.filter((_, start) => start !== chosen);
    const line = (paths) => paths.flatMap((path) => [...broken(path), null]);
    const now = (paths) => paths.filter((path) => path.length).map((path) => place(path[path.length - 1]));
    return { others: line(others), answer: line([all[chosen]]), othersNow: now(others), answerNow: now([all[chosen]]) };
  }

  const around = (longitude) => ((longitude % 360) + 360) % 360;

  // A path on the map 0..360 degrees, [longitude, latitude, radius]: it breaks (null) where it crosses the seam.
  function onMap(path) {
    const points = [];
    path.forEach(([latitude, longitude], index) => {
      const here = [longitude * DEGREES, latitude * DEGREES];
      if (index > 0) {
        const before = [path[index - 1][1] * DEGREES, path[index - 1][0] * DEGREES];
        const [lap, lapBefore] = [Math.floor(here[0] / 360), Math.floor(before[0] / 360)];
        if (lap !== lapBefore) {
          const seam = 360 * Math.max(lap, lapBefore);
          const share = (seam - before[0]) / (here[0] - before[0]);
          const crossing = before[1] + share * (here[1] - before[1]);
          points.push([lap > lapBefore ? 360 : 0, crossing], null, [lap > lapBefore ? 0 : 360, crossing]);
        }
      }
      points.push([around(here[0]), here[1]]);
    });
    return points;
  }

  const toMap = ([latitude, longitude]) => [around(longitude * DEGREES), latitude * DEGREES];
  const flat = (points) => ({ x: points.map((each) => each && each[0]), y: points.map((each) => each && each[1]) });
  const solid = (points) => ({ ...flat(points), z: points.map((each) => each && each[2]) });

  function mapWays(shown) {
    const { others, answer, othersNow, answerNow } = parted(shown, onMap, toMap);
    return [others, others, answer, answer, othersNow, answerNow].map(flat);
  }

  function mapFigure(shown) {
    const { example, landscape } = shown;
    const [halo, otherLine] = landscape ? ["#ffffff", "#3A3A3A"] : [colour("halo"), colour("others")];
    const mark = { line: { color: "#ffffff", width: 1.2 } };
    const plain = { type: "scatter", mode: "lines", hoverinfo: "skip" };
    const points = { type: "scatter", mode: "markers", cliponaxis: false };
    const hover = "longitude %{x:.1f}°, latitude %{y:.1f}°";
    const looks = [
      { ...plain, line: { color: halo, width: 3.2 } },
      { ...plain, line: { color: otherLine, width: 1.4 } },
      { ...plain, line: { color: halo, width: 5 } },
      { ...plain, line: { color: colour("answer"), width: 2.8 } },
      { ...points, marker: { ...mark, color: otherLine, size: 8 }, hovertemplate: `${hover}<extra>another start</extra>` },
      { ...points, marker: { ...mark, color: colour("answer"), size: 12, symbol: "diamond" }, hovertemplate: `${hover}<extra>answer</extra>` },
    ];
    const traces = [];
    if (landscape) {
      const { x, y, z } = closed(landscape);
      traces.push({
        type: "contour", x, y, z, colorscale: RELIEF, ncontours: 14, contours: { coloring: "heatmap" },
        line: { color: "rgba(255,255,255,0.35)", width: 0.7 },
        showscale: !narrow.matches,
        colorbar: { thickness: 10, outlinewidth: 0, len: 1, title: { text: landscape.name, side: "right", font: { size: 11 } } },
        hovertemplate: `${hover}: %{z:.4g}<extra>${landscape.name}</extra>`,
      });
    }
    if (example.starts)
      traces.push({ ...flat(example.starts.map(toMap)), ...points, marker: { color: "#ffffff", size: 8, line: { color: "#3A3A3A", width: 1.6 } }, hovertemplate: `${hover}<extra>start</extra>` });
    const moving = mapWays(shown).map((way, place) => ({ ...looks[place], ...way, meta: MOVES }));
    traces.push(...moving.slice(0, 4));
    if (example.truth)
      traces.push({ ...flat([toMap(example.truth)]), ...points, marker: { color: colour("truth"), size: 19, symbol: "star", line: { color: "#222222", width: 1.2 } }, hovertemplate: `${hover}<extra>true pose</extra>` });
    traces.push(...moving.slice(4));
    const furthest = Math.max(60, ...[example.truth ?? [0], example.ends[example.chosen]].map((pose) => Math.abs(pose[0] ?? 0) * DEGREES + 5));
    return {
      traces,
      layout: {
        xaxis: axis(narrow.matches ? "relative longitude" : "longitude of the query relative to the reference", { range: [0, 360], dtick: narrow.matches ? 90 : 60, ticksuffix: "°", zeroline: false }),
        yaxis: axis("latitude", { range: [-furthest, furthest], dtick: 30, ticksuffix: "°", zeroline: false }),
      },
    };
  }

  // Degrees [O + 1] and [A], values [A][O + 1]: 360 degrees is 0 again.
  function closed({ latitude, longitude, energy }) {
    return { x: [...longitude.map((each) => each * DEGREES), 360], y: latitude.map((each) => each * DEGREES), z: energy.map((row) => [...row, row[0]]) };
  }

  // The landscape's value at a point of the map, between its own points in proportion.
  function heights(landscape) {
    const { x, y, z } = closed(landscape);
    const all = z.flat().filter((each) => each !== null);
    const [low, high] = [Math.min(...all), Math.max(...all)];
    const lift = 0.03 * (high - low || 1);
    return ([longitude, latitude]) => {
      const across = Math.min((longitude / 360) * (x.length - 1), x.length - 1 - 1e-9);
      const along = Math.max(0, Math.min(((latitude - y[0]) / (y[y.length - 1] - y[0])) * (y.length - 1), y.length - 1 - 1e-9));
      const [column, row] = [Math.floor(across), Math.floor(along)];
      const [right, up] = [across - column, along - row];
      const between = (r) => (1 - right) * z[r][column] + right * z[r][column + 1];
      return (1 - up) * between(row) + up * between(row + 1) + lift;
    };
  }

  function surfaceWays(shown) {
    const height = heights(shown.landscape);
    const raised = (point) => point && [...point, height(point)];
    const { others, answer, othersNow, answerNow } = parted(shown, (path) => onMap(path).map(raised), (pose) => raised(toMap(pose)));
    return [others, answer, othersNow, answerNow].map(solid);
  }

  function surfaceFigure(shown) {
    const { example, landscape } = shown;
    const { x, y, z } = closed(landscape);
    const height = heights(landscape);
    const plain = { type: "scatter3d", hoverinfo: "skip" };
    const looks = [
      { ...plain, mode: "lines", line: { color: "#ffffff", width: 3 } },
      { ...plain, mode: "lines", line: { color: colour("answer"), width: 8 } },
      { ...plain, mode: "markers", marker: { color: "#3A3A3A", size: 5, line: { color: "#ffffff", width: 1 } } },
      { ...plain, mode: "markers", marker: { color: colour("answer"), size: 7, symbol: "diamond", line: { color: "#ffffff", width: 1 } } },
    ];
    const top = Math.max(...z.flat().filter((each) => each !== null));
    const truth = example.truth ? [toMap(example.truth)] : [];
    const traces = [
      { type: "surface", x, y, z, colorscale: RELIEF, showscale: false, lighting: { ambient: 0.75, diffuse: 0.5, specular: 0.05 },
        hovertemplate: `longitude %{x:.0f}°, latitude %{y:.0f}°: %{z:.4g}<extra>${landscape.name}</extra>` },
      lines(truth.map((place) => [[...place, height(place)], [...place, top]]), { line: { color: colour("truth"), width: 5 } }),
      dots(truth.map((place) => [...place, top]), { marker: { color: colour("truth"), size: 8, symbol: "diamond", line: { color: "#222222", width: 1.5 } } }),
      ...surfaceWays(shown).map((way, number) => ({ ...looks[number], ...way, meta: MOVES })),
    ];
    const side = (title, more) => ({ ...axis(title), backgroundcolor: "rgba(0,0,0,0)", showspikes: false, ...more });
    return {
      traces,
      layout: {
        margin: { l: 0, r: 0, t: 0, b: 0 },
        scene: {
          xaxis: side("longitude", { range: [0, 360], dtick: 90, ticksuffix: "°" }),
          yaxis: side("latitude", { dtick: 30, ticksuffix: "°" }),
          zaxis: side("", { nticks: 4 }),
          aspectmode: "manual", aspectratio: { x: 1.7, y: 1, z: 0.65 }, dragmode: "turntable",
          camera: { eye: { x: -0.5, y: -1.65, z: 2.1 }, center: { x: 0, y: 0, z: -0.15 } },
        },
      },
    };
  }

  // The query's view pose: the reference's plus a relative one.
  const posed = ({ reference }, relative) => relative.map((each, place) => each + reference.pose[place]);

  function cameraWays(shown) {
    const { example } = shown;
    const centre = (pose) => camera(posed(example, pose)).centre;
    const { others, answer, othersNow, answerNow } = parted(shown, (path) => path.map(centre), centre);
    const path = ways(shown)[example.chosen];
    const here = path[path.length - 1];
    const known = here.every((each) => each !== null);
    const frame = known ? pyramid(posed(example, here), reach(example)).flatMap((each) => [...each, null]) : [];
    return [others, answer, othersNow, answerNow, frame].map(solid);
  }

  const reach = ({ reference }) => 0.32 * reference.pose[2];

  function pairCamerasFigure(shown) {
    const { example, pixels, landscape } = shown;
    const { reference, truth } = example;
    const query = truth ? posed(example, truth) : null;
    const distance = reach(example);
    const furthest = 1.1 * Math.max(reference.pose[2], query ? query[2] : 0);
    const plain = { type: "scatter3d", hoverinfo: "skip" };
    const looks = [
      { ...plain, mode: "lines", line: { color: colour("others"), width: 2 } },
      { ...plain, mode: "lines", line: { color: colour("answer"), width: 5 } },
      { ...plain, mode: "markers", marker: { color: colour("others"), size: 4 } },
      { ...plain, mode: "markers", marker: { color: colour("answer"), size: 6, symbol: "diamond" } },
      { ...plain, mode: "lines", line: { color: colour("answer"), width: 5 } },
    ];
    return {
      traces: [
        ...ground(furthest),
        ...(landscape ? globe(landscape, reference.pose) : []),
        imagePlane(reference.pose, distance, pixels[0]),
        lines(pyramid(reference.pose, distance), { line: { color: colour("reference"), width: 5 } }),
        ...(query ? [imagePlane(query, distance, pixels[1]), lines(pyramid(query, distance), { line: { color: colour("truth"), width: 7 } })] : []),
        ...cameraWays(shown).map((way, number) => ({ ...looks[number], ...way, meta: MOVES })),
      ],
      layout: scene(furthest, reference.pose[1]),
    };
  }

  // In the object's place, what the landscape says of a camera above each of its points, around a plain core.
  function globe({ latitude, longitude, energy }, pose) {
    const turn = [...longitude, longitude[0] + 2 * Math.PI].map((east) => east + pose[1]);
    const halves = Array.from({ length: 13 }, (_, row) => ((row - 6) * Math.PI) / 12);
    return [
      { ...ball(halves, turn, 0.4), color: colour("line") },
      {
        ...ball(latitude.map((up) => up + pose[0]), turn, 0.42), intensity: energy.flatMap((row) => [...row, row[0]]),
        colorscale: RELIEF, showscale: false,
      },
    ];
  }

  // The part of a sphere with these latitudes and longitudes (a surface would do, but takes far longer to draw).
  function ball(ups, easts, radius) {
    const limit = Math.PI / 2;
    const points = ups.flatMap((up) => easts.map((east) => camera([Math.max(-limit, Math.min(limit, up)), east, radius]).centre));
    const [x, y, z] = [0, 1, 2].map((place) => points.map((point) => point[place]));
    const [i, j, k] = [[], [], []];
    for (let row = 0; row + 1 < ups.length; row++)
      for (let column = 0; column + 1 < easts.length; column++) {
        const corner = row * easts.length + column;
        const above = corner + easts.length;
        i.push(corner, corner + 1); j.push(corner + 1, above + 1); k.push(above, above);
      }
    return { type: "mesh3d", x, y, z, i, j, k, hoverinfo: "skip", lighting: { ambient: 0.9, diffuse: 0.3, specular: 0 } };
  }
})();

"use strict";
// Sortable tables, plots drawn when they scroll into view, and a slider that moves the marks of a pair along trajectories.
(() => {
  for (const table of document.querySelectorAll("table[data-sorts]")) {
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, column) => head.firstElementChild.addEventListener("click", () => {
      // First click: numbers in descending order, words in ascending order.
      const [first, other] = head.classList.contains("number") ? ["descending", "ascending"] : ["ascending", "descending"];
      const order = head.getAttribute("aria-sort") === first ? other : first;
      for (const each of heads) each.setAttribute("aria-sort", each === head ? order : "none");
      const sign = order === "ascending" ? 1 : -1;
      const sorted = [...table.tBodies[0].rows].map((row) => [sortKey(row.cells[column]), row]).sort(([a], [b]) => {
        if (a === "" || b === "") return (a === "") - (b === ""); // missing values are always last
        return sign * (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true }));
      });
      table.tBodies[0].append(...sorted.map(([, row]) => row));
    }));
  }

  // The number at the start of the text, or else the text.
  function sortKey(cell) {
    const text = (cell.dataset.value ?? cell.textContent.trim()).replace("\u2212", "-").replace(/^(inf|\u221e)$/, "Infinity");
    const number = parseFloat(text);
    return Number.isNaN(number) || cell.classList.contains("word") ? text : number;
  }

  async function unpack(packed) {
    const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }

  let library = null; // promise of plotly.js, unpacked on first use
  const plotly = () => (library ??= (async () => {
    const script = document.createElement("script");
    script.textContent = await unpack(document.getElementById("plotly").textContent);
    document.head.append(script);
    return window.Plotly;
  })());

  const CONFIG = { displaylogo: false, responsive: true, scrollZoom: false, displayModeBar: false };
  const drawn = new Map(); // element -> figure in the current colours

  async function draw(element) {
    try {
      const [text] = await Promise.all([unpack(element.dataset.figure), plotly()]);
      const colours = getComputedStyle(document.documentElement);
      const inColour = text.replace(/var\((--\w+)\)/g, (_, name) => colours.getPropertyValue(name).trim());
      drawn.set(element, JSON.parse(inColour));
      element.classList.add("drawn");
      await show(element);
    } catch (error) {
      element.classList.replace("drawn", "failed");
      element.dataset.failed = `This browser cannot draw the plot (${error.message}).`;
    }
  }

  // Draw a plot; for a pair, with the marks at the slider's step and only the selected landscape.
  function show(element) {
    const { data, layout } = drawn.get(element);
    const [slider, choice] = ["input", "select"].map((name) => element.closest(".stage")?.querySelector(name));
    if (slider) layout.meta.frames[slider.value].forEach((points, place) => Object.assign(data[layout.meta.traces[place]], points));
    if (choice) for (const trace of data) if (trace.meta) trace.visible = trace.meta === choice.value;
    return window.Plotly.react(element, data, layout, CONFIG);
  }

  const comesIntoView = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting) continue;
      comesIntoView.unobserve(target);
      draw(target);
    }
  }, { rootMargin: "200px" });
  for (const element of document.querySelectorAll(".plot")) comesIntoView.observe(element);

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const element of drawn.keys()) draw(element);
  });

  for (const pairs of document.querySelectorAll(".pairs")) {
    const [cards, stages] = [".card", ".stage"].map((name) => [...pairs.querySelectorAll(name)]);
    stages.forEach(startStage);
    cards.forEach((card, chosen) => card.addEventListener("click", () => {
      cards.forEach((each, place) => each.setAttribute("aria-pressed", String(place === chosen)));
      stages.forEach((stage, place) => {
        stage.hidden = place !== chosen;
        if (stage.hidden) stage.querySelectorAll(".plot.drawn").forEach(removePlot);
      });
    }));
  }

  // Browsers limit the number of WebGL contexts, so plots of hidden pairs are removed and drawn again when shown.
  function removePlot(element) {
    window.Plotly.purge(element);
    drawn.delete(element);
    element.classList.remove("drawn");
    comesIntoView.observe(element);
  }

  // The slider of a pair moves the marks of all three plots.
  function startStage(stage) {
    const [slider, play, output, choice] = ["input", "button", "output", "select"].map((name) => stage.querySelector(name));
    const update = () => stage.querySelectorAll(".plot.drawn").forEach(show);
    choice?.addEventListener("change", update);
    if (!slider) return;
    const steps = stage.dataset.steps.split(" ");
    const last = steps.length - 1;
    let playing = null;

    function go(place) {
      slider.value = String(place);
      output.textContent = `step ${steps[place]} of ${steps[last]}`;
      update();
    }

    function stop() {
      clearInterval(playing);
      playing = null;
      play.textContent = "Play";
    }

    function start() {
      play.textContent = "Pause";
      go(Number(slider.value) % last);
      playing = setInterval(() => {
        go(Number(slider.value) + 1);
        if (Number(slider.value) === last || stage.hidden) stop();
      }, 6000 / last); // playback takes six seconds
    }

    slider.addEventListener("input", () => { stop(); go(Number(slider.value)); });
    play.addEventListener("click", () => (playing === null ? start() : stop()));
  }
})();

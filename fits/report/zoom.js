// A stretch that is dragged over fills its panel; a double click shows all again.
for (const svg of document.querySelectorAll("svg[data-spans]")) {
  JSON.parse(svg.dataset.spans).forEach(([first, last], k) => {
    const moving = [...svg.querySelectorAll(`[id*="-zoom${k}-"]`)];
    const ticks = [...svg.querySelectorAll(`[id$="-ticks${k}"] > [id*="xtick_"]`)];
    const clip = moving.map(g => g.querySelector("[clip-path]")?.getAttribute("clip-path")).find(Boolean);
    if (!clip || !ticks.length) return;
    const box = svg.querySelector(clip.slice(4, -1) + " rect");
    const [left, top, width, height] = ["x", "y", "width", "height"].map(name => +box.getAttribute(name));
    const make = (name, values) => {
      const made = document.createElementNS(svg.namespaceURI, name);
      Object.entries(values).forEach(([key, value]) => made.setAttribute(key, value));
      return made;
    };
    for (const g of moving) {
      // The frame stays where it is when what is in it is stretched.
      g.querySelectorAll("[clip-path]").forEach(path => path.removeAttribute("clip-path"));
      const frame = make("g", { "clip-path": clip });
      g.replaceWith(frame);
      frame.append(g);
    }
    const chosen = make("rect", { y: top, height, fill: "#0072b2", "fill-opacity": 0.15 });
    const pad = make("rect", { x: left, y: top, width, height, fill: "transparent", class: "zoom" });
    svg.append(chosen, pad);
    let from = 0, to = 1, start = null, made = [];
    const at = event => {
      const x = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse()).x;
      return Math.min(1, Math.max(0, (x - left) / width));
    };
    const show = () => {
      const scale = 1 / (to - from), shift = left - scale * (left + from * width);
      moving.forEach(g => g.setAttribute("transform", `matrix(${scale} 0 0 1 ${shift} 0)`));
      made.forEach(tick => tick.remove());
      ticks.forEach(tick => { tick.style.display = scale > 1 ? "none" : ""; });
      made = [];
      if (scale === 1) return;
      const begin = first + from * (last - first), end = first + to * (last - first);
      const ten = 10 ** Math.floor(Math.log10((end - begin) / 4));
      const step = ten * [1, 2, 5, 10].find(by => (end - begin) / (ten * by) <= 5);
      const places = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
      for (let n = Math.ceil(begin / step); n * step <= end; n++) {
        const tick = ticks[0].cloneNode(true);
        [tick, ...tick.querySelectorAll("[id]")].forEach(one => one.removeAttribute("id"));
        const old = +ticks[0].querySelector("use").getAttribute("x");
        const x = left + width * (n * step - begin) / (end - begin);
        tick.setAttribute("transform", `translate(${x - old} 0)`);
        tick.style.display = "";
        tick.querySelector("text").textContent = (n * step).toFixed(places);
        ticks[0].after(tick);
        made.push(tick);
      }
    };
    const drag = event => {
      if (start === null) return;
      const now = at(event);
      chosen.setAttribute("x", left + width * Math.min(start, now));
      chosen.setAttribute("width", width * Math.abs(now - start));
    };
    pad.addEventListener("pointerdown", event => { start = at(event); });
    pad.addEventListener("pointermove", drag);
    addEventListener("pointerup", event => {
      if (start === null) return;
      const [low, high] = [start, at(event)].sort((a, b) => a - b), span = to - from;
      start = null;
      chosen.setAttribute("width", 0);
      if ((high - low) < 0.01 || span * (high - low) < 1e-5) return;
      [from, to] = [from + span * low, from + span * high];
      show();
    });
    pad.addEventListener("pointercancel", () => { start = null; chosen.setAttribute("width", 0); });
    pad.addEventListener("dblclick", () => { [from, to] = [0, 1]; show(); });
    svg.closest("figure").querySelector(".hint").hidden = false;
  });
}

"use strict";
// The traces of a run: data from the page's blocks (adacd_hil/lab/report/traces.py says how they are written),
// drawn by uPlot. All panels show the same stretch of time; where a pixel has several cycles, their smallest and largest
// value are drawn, found through the extremes of blocks of 64 cycles.
(async () => {
  const root = document.documentElement;
  const planElement = document.getElementById("trace-plan");
  if (!planElement || !window.uPlot || !window.DecompressionStream) return;
  root.classList.add("with-scripts");

  const BLOCK = 64;
  const MOST_POINTS_PER_PIXEL = 2;
  const SHORTEST_ROWS = 8;
  const HEIGHT = 190;
  const PANEL_PADDING = 30;  // of a panel's frame, both sides together, px
  const PAPER_WIDTH = 690;  // A4 without its margins, px
  const plan = JSON.parse(planElement.textContent);

  // --- data ---------------------------------------------------------------------------------------------------------

  function bytesOf(text) {
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
    const letters = atob(text);
    const bytes = new Uint8Array(letters.length);
    for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
    return bytes;
  }

  async function collect(reader, length) {
    const bytes = new Uint8Array(length);
    let place = 0;
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return bytes;
      bytes.set(value, place);
      place += value.length;
    }
  }

  function decode(planes, series, count) {
    const codes = new Int32Array(count);
    for (let plane = 0; plane < series.planes; plane++) {
      const first = plane * count;
      const shift = 8 * plane;
      for (let row = 0; row < count; row++) codes[row] |= planes[first + row] << shift;
    }
    for (let order = 0; order < series.order; order++) {
      let sum = 0;
      for (let row = 0; row < count; row++) {
        const code = codes[row];
        sum = (sum + (order ? code : (code >>> 1) ^ -(code & 1))) | 0;
        codes[row] = sum;
      }
    }
    return codes;
  }

  async function unpack(series, count) {
    const element = document.getElementById(series.id);
    const stream = new DecompressionStream("deflate");
    const writer = stream.writable.getWriter();
    writer.write(bytesOf(element.textContent));
    writer.close();
    const planes = await collect(stream.readable.getReader(), count * series.planes);
    element.remove();
    return decode(planes, series, count);
  }

  function extremesOf(codes) {
    const count = codes.length;
    const blocks = Math.ceil(count / BLOCK);
    const low = new Int32Array(blocks);
    const high = new Int32Array(blocks);
    for (let block = 0; block < blocks; block++) {
      const end = Math.min(count, (block + 1) * BLOCK);
      let least = 0x7fffffff;
      let most = 0;
      for (let row = block * BLOCK; row < end; row++) {
        const code = codes[row];
        if (code === 0) continue;
        if (code < least) least = code;
        if (code > most) most = code;
      }
      low[block] = most ? least : 0;
      high[block] = most;
    }
    return { low, high };
  }

  const valueOf = (curve, code) => (code === 0 ? null : curve.low + (code - 1) * curve.step);

  const timeAt = (track, row) => track.time.low + (track.codes[row] - 1) * track.time.step;

  function rowAt(track, t) {  // the first row that is not before t
    let low = 0;
    let high = track.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (timeAt(track, middle) < t) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  // --- what is shown ------------------------------------------------------------------------------------------------

  // Rows [first, last) in bins of `width` rows; a width of 1 is every cycle.
  function binsFor(track, from, to, pixels) {
    let first = Math.max(0, rowAt(track, from) - 1);
    let last = Math.min(track.count, rowAt(track, to) + 2);
    let width = Math.ceil((last - first) / Math.max(pixels, 100));
    if (width <= MOST_POINTS_PER_PIXEL) return { first, last, width: 1 };
    if (width > 2 * BLOCK) {
      width = Math.ceil(width / BLOCK) * BLOCK;
      first -= first % BLOCK;
      last = Math.min(track.count, Math.ceil(last / BLOCK) * BLOCK);
    }
    return { first, last, width };
  }

  function timesOf(track, bins) {
    const times = [];
    for (let row = bins.first; row < bins.last; row += bins.width) {
      times.push(timeAt(track, row));
      if (bins.width > 1) times.push(timeAt(track, Math.min(bins.last - 1, row + (bins.width >> 1))));
    }
    return times;
  }

  function valuesOf(curve, bins, sign) {
    const values = [];
    const put = (code) => {
      const value = valueOf(curve, code);
      values.push(value === null ? null : sign * value);
    };
    const isBlocked = bins.width >= BLOCK && bins.width % BLOCK === 0;
    const lows = isBlocked ? curve.extremes.low : curve.codes;
    const highs = isBlocked ? curve.extremes.high : curve.codes;
    const unit = isBlocked ? BLOCK : 1;
    for (let row = bins.first; row < bins.last; row += bins.width) {
      if (bins.width === 1) {
        put(curve.codes[row]);
        continue;
      }
      let least = 0;
      let most = 0;
      const end = Math.ceil(Math.min(bins.last, row + bins.width) / unit);
      for (let place = row / unit; place < end; place++) {
        if (highs[place] > most) most = highs[place];
        if (lows[place] && (!least || lows[place] < least)) least = lows[place];
      }
      put(least);
      put(most);
    }
    return values;
  }

  // --- panels -------------------------------------------------------------------------------------------------------

  const secondsText = (_, value) => (value === null || value === undefined ? "–" : value.toFixed(3));
  const dateText = (_, t) => (t === null || t === undefined ? "–" : new Date(1e3 * t).toLocaleString("sv").slice(0, 16));
  const datesText = (plot, splits) => splits.map((t) => dateText(plot, t).slice(2));
  const available = () => {  // a folded part has no width in some browsers
    const main = document.querySelector("main");
    const [left, right] = [getComputedStyle(main).paddingLeft, getComputedStyle(main).paddingRight];
    return Math.max(200, main.clientWidth - parseFloat(left) - parseFloat(right) - PANEL_PADDING);
  };
  const colour = (name) => getComputedStyle(root).getPropertyValue(`--${name}`).trim();
  const nearBox = document.getElementById("near");
  const shown = document.getElementById("shown");
  const panels = [];
  let start = 0;
  let end = 1;
  let view = [0, 1];

  function drawBands(plot) {
    const { ctx, bbox } = plot;
    const place = (t) => Math.min(Math.max(plot.valToPos(t, "x", true), bbox.left), bbox.left + bbox.width);
    const band = (from, to, name) => {
      if (to < view[0] || from > view[1]) return;
      ctx.fillStyle = name;
      const left = place(from);
      ctx.fillRect(left, bbox.top, Math.max(place(to) - left, devicePixelRatio), bbox.height);
    };
    ctx.save();
    for (const [from, to, name] of plan.bands) band(from, to, colour(name));
    for (const at of plan.faults) band(at, at, colour("alarm"));
    const touch = colour("touch");
    ctx.globalAlpha = 0.45;
    for (const [from, to] of plan.contacts) band(from, to, touch);
    ctx.restore();
  }

  function drawMarks(plot, levels) {
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.strokeStyle = colour("alarm");
    ctx.lineWidth = devicePixelRatio;
    for (const level of levels) {
      const y = plot.valToPos(level, "y", true);
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    }
    ctx.fillStyle = colour("ink");
    ctx.font = `600 ${10 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.textBaseline = "top";
    ctx.textAlign = "left";
    let free = -Infinity;
    for (const [from, to, number] of plan.contacts) {
      if (to < view[0] || from > view[1]) continue;
      const x = Math.max(plot.valToPos(from, "x", true), bbox.left) + 2 * devicePixelRatio;
      if (x < free) continue;
      ctx.fillText(number, x, bbox.top + 2 * devicePixelRatio);
      free = x + ctx.measureText(number).width + 3 * devicePixelRatio;
    }
    ctx.restore();
  }

  function rangeOf(panel, low, high) {
    if (nearBox && nearBox.checked && panel.near) return [panel.name === "share" ? 0 : -panel.near, panel.near];
    if (low === null || high === null) return [-1, 1];
    const margin = 0.06 * (high - low) || 0.05 * Math.abs(high) || 0.1;
    return [low - margin, high + margin];
  }

  function digitsFor(panel) {
    return Math.max(0, Math.ceil(-Math.log10(Math.min(...panel.curves.map((curve) => curve.step))) - 0.3));
  }

  function makePanel(track, panel, width) {
    const place = document.querySelector(`#panel-${CSS.escape(panel.name)} .plot`);
    const digits = Math.min(digitsFor(panel), 5);
    const drawn = panel.curves.flatMap((curve) =>
      curve.isMirrored ? [{ curve, sign: 1 }, { curve, sign: -1 }] : [{ curve, sign: 1 }]);
    const series = drawn.map(({ curve, sign }) => ({
      label: sign < 0 ? "" : curve.label,
      stroke: () => colour(curve.colour),
      width: curve.isDashed ? 1 : 1.2,
      dash: curve.isDashed ? [5, 3] : undefined,
      points: { show: (plot) => bins(plot).width === 1 && bins(plot).last - bins(plot).first < 100, size: 4 },
      class: sign < 0 ? "mirror" : undefined,
      value: (_, value) => (value === null || value === undefined ? "–" : value.toFixed(digits).replace("-", "−")),
    }));
    const bins = (plot) => binsFor(track, view[0], view[1], plot.bbox.width / devicePixelRatio);
    const axis = (size, more) => ({
      stroke: () => colour("muted"),
      values: (_, splits) => splits.map((value) => String(+value.toPrecision(10)).replace("-", "−")),
      grid: { stroke: () => colour("grid"), width: 1 },
      ticks: { stroke: () => colour("rule"), width: 1, size: 4 },
      font: "11px system-ui, sans-serif",
      size,
      ...more,
    });
    const plot = new uPlot({
      width,
      height: HEIGHT,
      scales: { x: { time: plan.isDated, range: () => view }, y: { range: (_, low, high) => rangeOf(panel, low, high) } },
      axes: [axis(28, plan.isDated ? { space: 110, values: datesText } : { space: 70 }), axis(56, { space: 28 })],
      series: [plan.isDated ? { label: "run of", value: dateText } : { label: "s", value: secondsText }, ...series],
      cursor: { sync: { key: "time" }, drag: { x: true, y: false, setScale: false }, points: { size: 6 } },
      legend: { live: true },
      hooks: {
        drawClear: [drawBands],
        draw: [(drawnPlot) => drawMarks(drawnPlot, panel.levels)],
        setSelect: [(drawnPlot) => {
          const { left, width } = drawnPlot.select;
          if (width < 4) return;
          const from = drawnPlot.posToVal(left, "x");
          const to = drawnPlot.posToVal(left + width, "x");
          drawnPlot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
          show(from, to);
        }],
      },
    }, [[], ...drawn.map(() => [])], place);
    const update = () => {
      const current = bins(plot);
      plot.setData([timesOf(track, current), ...drawn.map(({ curve, sign }) => valuesOf(curve, current, sign))], true);
    };
    const paint = () => {  // the legend's marks, which uPlot paints but once
      plot.root.querySelectorAll(".u-series").forEach((row, index) => {
        const mark = row.querySelector(".u-marker");
        if (index > 0 && mark) mark.style.borderColor = colour(drawn[index - 1].curve.colour);
      });
    };
    follow(plot);
    return { plot, place, update, paint };
  }

  // --- moving about -------------------------------------------------------------------------------------------------

  let isDue = false;

  function drawAll() {
    isDue = false;
    for (const panel of panels) panel.update();
    tell();
  }

  function tell() {
    if (!shown) return;
    const digits = view[1] - view[0] < 1 ? 4 : 2;
    shown.textContent = `${view[0].toFixed(digits)} to ${view[1].toFixed(digits)} s`.replaceAll("-", "−");
  }

  function show(from, to) {
    const shortest = SHORTEST_ROWS * plan.period;
    const span = Math.min(Math.max(to - from, shortest), end - start);
    const middle = Math.min(Math.max(0.5 * (from + to), start + 0.5 * span), end - 0.5 * span);
    view = [middle - 0.5 * span, middle + 0.5 * span];
    if (isDue) return;
    isDue = true;
    requestAnimationFrame(drawAll);
  }

  function zoom(factor, at = 0.5 * (view[0] + view[1])) {
    show(at - (at - view[0]) * factor, at + (view[1] - at) * factor);
  }

  function move(share) {
    const step = share * (view[1] - view[0]);
    show(view[0] + step, view[1] + step);
  }

  function follow(plot) {
    plot.over.addEventListener("wheel", (event) => {
      if (event.ctrlKey) return;
      event.preventDefault();
      zoom(event.deltaY < 0 ? 0.8 : 1.25, plot.posToVal(event.offsetX, "x"));
    }, { passive: false });
    plot.over.addEventListener("dblclick", () => show(start, end));
    plot.over.addEventListener("mousedown", (event) => {
      if (event.button !== 0 || !event.shiftKey) return;
      event.stopImmediatePropagation();
      const perPixel = (view[1] - view[0]) / plot.over.clientWidth;
      const [from, to] = view;
      const drag = (moved) => {
        const shift = (event.clientX - moved.clientX) * perPixel;
        show(from + shift, to + shift);
      };
      document.addEventListener("mousemove", drag);
      document.addEventListener("mouseup", () => document.removeEventListener("mousemove", drag), { once: true });
    }, true);
  }

  const MOVES = {
    earlier: () => move(-0.5), later: () => move(0.5), in: () => zoom(0.5), out: () => zoom(2), all: () => show(start, end),
  };

  function listen() {
    for (const button of document.querySelectorAll("[data-move]")) {
      button.addEventListener("click", MOVES[button.dataset.move]);
    }
    if (nearBox) nearBox.addEventListener("change", drawAll);
    for (const mark of document.querySelectorAll("[data-from]")) {
      const go = () => {
        show(Number(mark.dataset.from), Number(mark.dataset.to));
        const bar = document.querySelector(".bar");
        bar.closest("details").open = true;
        bar.scrollIntoView({ behavior: "smooth", block: "start" });
      };
      mark.setAttribute("tabindex", "0");
      mark.setAttribute("role", "button");
      mark.addEventListener("click", go);
      mark.addEventListener("keydown", (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        go();
      });
    }
    const fit = (width) => {
      for (const { plot, paint } of panels) {
        plot.setSize({ width, height: HEIGHT });
        paint();
      }
      drawAll();
    };
    new ResizeObserver(() => {
      if (panels[0].plot.width !== available() && !root.classList.contains("on-paper")) fit(available());
    }).observe(document.querySelector("main"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => fit(available()));
    let folded = [];
    window.addEventListener("beforeprint", () => {
      folded = [...document.querySelectorAll("details:not([open])")];
      for (const part of folded) part.open = true;
      root.classList.add("on-paper");
      fit(PAPER_WIDTH);
    });
    window.addEventListener("afterprint", () => {
      for (const part of folded) part.open = false;
      root.classList.remove("on-paper");
      fit(available());
    });
  }

  // --- begin --------------------------------------------------------------------------------------------------------

  for (const track of plan.tracks) track.codes = await unpack(track.time, track.count);
  start = Math.min(...plan.tracks.map((track) => timeAt(track, 0)));
  end = Math.max(...plan.tracks.map((track) => timeAt(track, track.count - 1)));
  view = [start, end];
  for (const track of plan.tracks) {
    for (const panel of track.panels) {
      await Promise.all(panel.curves.map(async (curve) => {
        curve.codes = await unpack(curve, track.count);
        curve.extremes = extremesOf(curve.codes);
      }));
      const made = makePanel(track, panel, available());
      panels.push(made);
      made.update();
    }
  }
  tell();
  listen();
  root.dataset.traces = "drawn";
})();

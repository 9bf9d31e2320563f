// The figures, each drawn when it is first scrolled to; colours follow the page's.
"use strict";
(() => {
  const page = JSON.parse(document.getElementById("page").textContent);
  const { axes } = page;
  const drawn = new Map(); // and how wide
  const seeds = new WeakMap();

  // plotly reads some HTML in names
  const plain = (text) => text.replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
  const floats = (text) => new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

  function decoded(block) {
    const read = (each) => each && each.map(floats);
    return {
      truth: read(block.truth),
      kind: block.kind,
      tracks: block.tracks.map((track) => ({
        ...track, t: floats(track.t), p: read(track.p), error: read(track.error), sigma: read(track.sigma),
      })),
    };
  }

  // the tracks of the chosen seed, decoded once
  function chosen(section) {
    const k = Number(section.querySelector("select.seed")?.value ?? 0);
    const script = section.querySelectorAll("script.tracks")[k];
    if (!seeds.has(script)) seeds.set(script, decoded(JSON.parse(script.textContent)));
    return seeds.get(script);
  }

  function span(arrays) {
    let [low, high] = [Infinity, -Infinity];
    for (const array of arrays) for (const x of array) if (x < low || x > high) [low, high] = [Math.min(low, x), Math.max(high, x)];
    const margin = 0.06 * (high - low || 1);
    return low <= high ? [low - margin, high + margin] : undefined;
  }

  // later lines are thinner, so that those below show
  function line(of, extra) {
    const look = page.looks[of.label];
    const rank = Object.keys(page.looks).indexOf(of.label) / Object.keys(page.looks).length;
    const style = { color: look.colour, dash: of.online ? look.dash : "dot", width: of.online ? 3 - 1.8 * rank : 1.2 };
    return { type: "scatter", mode: "lines", name: plain(of.name), legendgroup: plain(of.name), line: style, ...extra };
  }

  // plain numbers over at least a factor of four, so that small differences look small
  function logarithmic(values) {
    const found = values.filter((x) => x > 0).map(Math.log10);
    const [low, high] = [Math.min(...found), Math.max(...found)];
    const [middle, half] = [(low + high) / 2, Math.max((high - low) / 2, Math.log10(2))];
    return { type: "log", tickformat: "~g", nticks: 6, range: [middle - 1.1 * half, middle + 1.1 * half] };
  }

  const DRAW = {
    tracks(section) {
      const { truth, kind, tracks } = chosen(section);
      const traces = tracks.map((track) => line(track, {
        x: track.p[0], y: track.p[1], customdata: track.t, hovertemplate: axes.of_track,
      }));
      if (truth) {
        const ink = colour("ink");
        traces.unshift({ type: "scatter", mode: "lines", name: plain(kind), x: truth[0], y: truth[1], line: { color: ink, width: 5 }, opacity: 0.3, hoverinfo: "skip" });
        traces.push({ type: "scatter", mode: "markers", name: "start", x: truth[0].slice(0, 1), y: truth[1].slice(0, 1), marker: { color: ink, size: 9 }, hoverinfo: "name" });
      }
      // where one axis follows the other, margins that follow the labels of both move without end
      const layout = {
        xaxis: { title: { text: axes.east }, automargin: false },
        yaxis: { title: { text: axes.north }, scaleanchor: "x", automargin: false },
      };
      if (tracks.some((track) => !track.near)) { // one that got lost may leave the picture
        const inside = tracks.filter((track) => track.near).map((track) => track.p);
        if (truth) inside.push(truth);
        layout.xaxis.range = span(inside.map((p) => p[0]));
        layout.yaxis.range = span(inside.map((p) => p[1]));
      }
      return [traces, layout];
    },

    errors(section) {
      const tracks = chosen(section).tracks.filter((track) => track.error);
      const only = section.querySelector("select.estimator").value;
      const shown = tracks.filter((track) => only === "" || track.label === only);
      const known = axes.errors.map((_, axis) => axis).filter((axis) => tracks.some((track) => track.error[axis].some(Number.isFinite)));
      const traces = [];
      const layout = { xaxis: { title: { text: axes.time }, anchor: `y${known.length > 1 ? known.length : ""}` } };
      known.forEach((axis, k) => {
        const yaxis = `y${k ? k + 1 : ""}`;
        const height = 1 / known.length;
        const panel = { title: { text: axes.errors[axis] }, domain: [1 - (k + 1) * height + 0.02, 1 - k * height - 0.02] };
        if (only === "" && shown.some((track) => !track.near) && shown.some((track) => track.near)) {
          panel.range = span(shown.filter((track) => track.near).map((track) => track.error[axis]));
        }
        layout[`yaxis${k ? k + 1 : ""}`] = panel;
        for (const track of shown) {
          if (only !== "" && track.sigma && track.online) {
            const bound = track.sigma[axis].map((sigma) => 3 * sigma);
            const edge = { ...line(track), x: track.t, yaxis, line: { width: 0 }, hoverinfo: "skip", showlegend: false };
            traces.push({ ...edge, y: bound.map((x) => -x) });
            traces.push({ ...edge, y: bound, fill: "tonexty", fillcolor: `${page.looks[track.label].colour}33`, name: "±3σ", showlegend: k === 0 });
          }
          traces.push(line(track, { x: track.t, y: track.error[axis], yaxis, showlegend: k === 0, hovertemplate: axes.of_error }));
        }
      });
      return [traces, layout];
    },

    anees(section) {
      const lines = page.logs[section.dataset.log].anees[section.querySelector("select.block").value];
      const widest = lines.reduce((a, b) => (b.runs > a.runs ? b : a));
      const edge = { type: "scatter", mode: "lines", x: widest.t, line: { width: 0 }, hoverinfo: "skip", showlegend: false };
      const traces = [
        { ...edge, y: widest.low },
        { ...edge, y: widest.high, fill: "tonexty", fillcolor: "rgba(128,128,128,0.2)", name: `consistent, ${widest.runs} seeds`, showlegend: true },
      ];
      for (const of of lines) {
        const { symbol } = page.looks[of.label];
        traces.push(line(of, {
          x: of.t, y: of.value, mode: "lines+markers", marker: { symbol: of.online ? symbol : `${symbol}-open`, size: 7, color: page.looks[of.label].colour },
          text: of.says, hovertemplate: "%{text}",
        }));
      }
      return [traces, { xaxis: { title: { text: axes.time } }, yaxis: { title: { text: axes.nees }, ...logarithmic([widest.low, widest.high, ...lines.map((of) => of.value)].flat()) } }];
    },

    costs(section) {
      const { costs } = page.logs[section.dataset.log];
      const traces = [...new Set(costs.map((of) => of.label))].map((label) => {
        const points = costs.filter((of) => of.label === label);
        const look = page.looks[label];
        return {
          type: "scatter", mode: "lines+markers", name: plain(label), x: points.map((of) => of.x), y: points.map((of) => of.y),
          text: points.map((of) => `${of.says}<br>${of.output}`), line: { color: look.colour, width: 1 },
          marker: { color: look.colour, size: 11, symbol: points.map((of) => (of.online ? look.symbol : `${look.symbol}-open`)) },
          hovertemplate: "%{text}",
        };
      });
      const [x, y] = ["x", "y"].map((name) => logarithmic(traces.flatMap((trace) => trace[name])));
      return [traces, { xaxis: { title: { text: axes.computing }, ...x }, yaxis: { title: { text: axes.ate }, ...y } }];
    },
  };

  function dressed(layout, plot, traces) {
    const [ink, line, grid, paper] = ["ink", "line", "grid", "paper"].map(colour);
    const axis = { gridcolor: grid, linecolor: line, zerolinecolor: line, automargin: true, exponentformat: "none" };
    const named = traces.filter((trace) => trace.showlegend !== false);
    const widest = Math.max(...named.map((trace) => trace.name.length), 1) * 7 + 60;
    const columns = Math.max(1, Math.floor((plot.clientWidth - 72) / (widest + 40)));  // less margins; with its line
    const lines = Math.ceil(named.length / columns);
    const base = plot.matches(".tall") ? 560 : 480;
    const out = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: ink, family: "inherit", size: 13 },
      margin: { l: 60, r: 12, t: 24, b: 48 + 22 * lines }, width: plot.clientWidth, height: base + 22 * lines,
      hovermode: "closest", hoverlabel: { bgcolor: paper, font: { color: ink }, bordercolor: line, namelength: -1 },
      legend: { orientation: "h", yref: "container", y: 0, yanchor: "bottom", x: 0, tracegroupgap: 0, entrywidth: Math.min(widest, plot.clientWidth - 20), entrywidthmode: "pixels" },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: line, activecolor: ink }, uirevision: plot.dataset.kind,
    };
    for (const [name, value] of Object.entries(layout)) out[name] = /axis/.test(name) ? { ...axis, ...value } : value;
    return out;
  }

  function draw(plot) {
    const [traces, layout] = DRAW[plot.dataset.kind](plot.closest(".log"));
    // plotly's own choice of buttons has one that uploads the figure
    const config = {
      displaylogo: false, typesetMath: false, showTips: false, doubleClick: "reset",
      modeBarButtons: [["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]],
      toImageButtonOptions: { format: "svg" },
    };
    drawn.set(plot, plot.clientWidth);
    return Plotly.react(plot, traces, dressed(layout, plot, traces), config);
  }

  function listEstimators(section) {
    const select = section.querySelector("select.estimator");
    if (!select) return;
    const tracks = JSON.parse(section.querySelector("script.tracks").textContent).tracks.filter((track) => track.error);
    const labels = [...new Set(tracks.map((track) => track.label))];
    select.append(...labels.map((label) => new Option(label, label)), new Option("all, without σ", ""));
    select.value = (tracks.find((track) => track.sigma) ?? tracks[0])?.label ?? "";
  }

  window.drawFigures = () => {
    const plots = [...document.querySelectorAll(".plot")];
    const seen = new IntersectionObserver((entries) => {
      for (const entry of entries) if (entry.isIntersecting && !drawn.has(entry.target)) draw(entry.target);
    }, { rootMargin: "300px" });
    for (const section of document.querySelectorAll(".log")) {
      listEstimators(section);
      section.addEventListener("change", () => {
        for (const plot of section.querySelectorAll(".plot")) if (drawn.has(plot)) draw(plot);
      });
    }
    plots.forEach((plot) => seen.observe(plot));
    const resized = new ResizeObserver((entries) => {
      for (const { target } of entries) if (drawn.has(target) && drawn.get(target) !== target.clientWidth) draw(target);
    });
    plots.forEach((plot) => resized.observe(plot));
    const again = () => [...drawn.keys()].forEach(draw);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
    matchMedia("print").addEventListener("change", again);
    window.addEventListener("beforeprint", () => plots.forEach(draw));
  };
})();

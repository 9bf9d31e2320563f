// The table of all runs, and what opens under one. Rows are made as they are scrolled to; what a row opens to is
// unpacked when it is asked for. All text goes in as text, never as HTML.
"use strict";
(() => {
  const AT_ONCE = 1000;
  const body = document.querySelector("table.runs");
  const more = document.getElementById("more");
  const blocks = [...document.querySelectorAll("script.details")];
  const rows = new Map(); // those that were made, by the run's place
  let table = null;
  let order = []; // by group, the places of its runs as they are sorted
  let found = null; // by place, whether the filter lets a run through; null without a filter
  let [shown, left] = [0, []];

  const unpacked = new Map();
  function unpack(script) {
    if (!unpacked.has(script)) unpacked.set(script, window.unpack(script).then(JSON.parse));
    return unpacked.get(script);
  }

  function element(kind, text, ...inside) {
    const made = document.createElement(kind);
    if (text !== null) made.textContent = text;
    made.append(...inside);
    return made;
  }

  // -- rows -----------------------------------------------------------------------------------------------------------

  // what a column is sorted by
  function valueOf(place, column) {
    if (column === 0) return table.labels[table.label[place]];
    if (column === 1) return table.seed[place];
    if (column === 2) return table.statuses[table.status[place]];
    return column - 3 < table.scores.length ? table.scores[column - 3].value[place] : table.identity[place];
  }

  function texts(place) {
    const seed = table.seed[place];
    const scores = table.scores.map((score) => score.text[place]);
    return [valueOf(place, 0), seed === null ? "–" : String(seed), valueOf(place, 2), ...scores, table.identity[place]];
  }

  function made(place) {
    if (rows.has(place)) return rows.get(place);
    const row = document.createElement("tr");
    row.dataset.run = place;
    texts(place).forEach((text, column) => {
      const cell = element(column ? "td" : "th", column ? text : null);
      const value = valueOf(place, column);
      if (value !== null) cell.dataset.value = value;
      if (typeof value === "string") cell.className = "text";
      if (!column) {
        const button = element("button", text);
        Object.assign(button, { type: "button", className: "opens" });
        button.setAttribute("aria-expanded", "false");
        cell.scope = "row";
        cell.className = "";
        cell.append(button);
      } else if (table.scores[column - 3]?.why[place]) cell.title = table.whys[table.scores[column - 3].why[place]];
      row.append(cell);
    });
    rows.set(place, row);
    return row;
  }

  function groupOf(k) {
    const heading = element("th", null, element("span", table.groups[k]));
    Object.assign(heading, { colSpan: table.scores.length + 4, scope: "rowgroup" });
    const title = element("tr", null, heading);
    title.className = "group";
    return element("tbody", null, title);
  }

  function showMore() {
    for (const place of left.slice(shown, shown + AT_ONCE)) {
      const k = table.group[place];
      if (body.tBodies.length === 0 || body.tBodies[body.tBodies.length - 1].dataset.group !== String(k)) {
        const group = groupOf(k);
        group.dataset.group = k;
        body.append(group);
      }
      const row = made(place);
      body.tBodies[body.tBodies.length - 1].append(...(row.detail ? [row, row.detail] : [row]));
    }
    shown = Math.min(left.length, shown + AT_ONCE);
    more.hidden = shown === left.length;
    more.firstElementChild.textContent = `${left.length - shown} more rows`;
  }

  function show() {
    for (const group of [...body.tBodies]) group.remove();
    left = order.flat();
    if (found !== null) left = left.filter((place) => found[place]);
    shown = 0;
    showMore();
  }

  body.sortRows = (column, sign) => {
    if (table === null) return;
    for (const places of order) places.sort((a, b) => window.compare(valueOf(a, column) ?? undefined, valueOf(b, column) ?? undefined, sign));
    show();
  };

  function filter(words) {
    const wanted = words.toLowerCase().split(/\s+/).filter(Boolean);
    const says = (place) => `${table.groups[table.group[place]]} ${texts(place).join(" ")}`.toLowerCase();
    found = wanted.length ? table.label.map((_, place) => wanted.every((word) => says(place).includes(word))) : null;
    document.getElementById("filtered").textContent = found === null ? "" : `${found.filter(Boolean).length} of ${found.length}`;
    show();
  }

  // -- what opens under a row -----------------------------------------------------------------------------------------

  function list(pairs) {
    const known = Object.entries(pairs).filter(([, value]) => value !== null && value !== undefined);
    return element("dl", null, ...known.map(([name, value]) =>
      element("div", null, element("dt", name), element("dd", typeof value === "object" ? JSON.stringify(value) : String(value)))));
  }

  function part(title, ...inside) {
    return element("section", null, element("h4", title), ...inside);
  }

  function describe(run, { specs, places, scores: names }) {
    const { commit, versions, machine } = places[run.place];
    const scores = Object.fromEntries(names.map((name, k) => [name, run.scores[k]]));
    const { spec, place, counts, notes, scores: _, ...about } = run;
    const parts = [
      part("Run", list(about)),
      part("Spec", element("pre", JSON.stringify({ seed: run.seed, ...specs[spec] }, null, 2))),
      part("Scores", list(scores)),
      part("Counts", list(counts)),
      part("Made by", list({ commit, ...machine, ...versions })),
    ];
    const sentences = Array.isArray(notes) ? notes : Object.values(notes);
    if (sentences.length) parts.splice(2, 0, part("Notes", element("ul", null, ...sentences.map((note) => element("li", note.kind === "about" ? note.text : `${note.kind}: ${note.text}`)))));
    return parts;
  }

  async function fill(box, place) {
    const common = await unpack(document.getElementById("common"));
    const block = await unpack(blocks[Math.floor(place / common.block)]);
    box.replaceChildren(...describe(block[place % common.block], common));
  }

  function toggle(button) {
    const row = button.closest("tr");
    const open = button.getAttribute("aria-expanded") === "true";
    button.setAttribute("aria-expanded", String(!open));
    if (open) {
      row.detail.remove();
      row.detail = null;
      return;
    }
    const box = element("div", "unpacking …");
    const cell = element("td", null, box);
    cell.colSpan = row.cells.length;
    row.detail = element("tr", null, cell);
    row.detail.className = "detail";
    row.after(row.detail);
    fill(box, Number(row.dataset.run)).catch((error) => { box.textContent = `cannot be unpacked: ${error}`; });
  }

  function begin(content) {
    table = content;
    order = table.groups.map(() => []);
    table.group.forEach((k, place) => order[k].push(place));
    filter(document.getElementById("filter").value);
    new IntersectionObserver((entries) => {
      if (entries.some((entry) => entry.isIntersecting) && !more.hidden) showMore();
    }, { rootMargin: "600px" }).observe(more);
  }

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (button?.matches(".opens")) toggle(button);
    if (button?.matches("#more button")) showMore();
  });
  document.getElementById("filter").addEventListener("input", (event) => { if (table !== null) filter(event.target.value); });
  const script = document.getElementById("table-of-runs");
  if (script.type === "application/json") begin(JSON.parse(script.textContent));
  else window.unpack(script).then(JSON.parse).then(begin);
})();

// Sorting, the filter of the runs, and what opens under a run. All text goes in as text, never as HTML.
"use strict";
(() => {
  const details = JSON.parse(document.getElementById("details").textContent);

  // numbers by size, words by alphabet (numbers in them by size), what is absent last either way
  function compare(a, b, sign) {
    if (a === undefined || b === undefined) return (a === undefined) - (b === undefined);
    const [x, y] = [Number(a), Number(b)];
    if (!Number.isNaN(x) && !Number.isNaN(y)) return sign * (x - y || 0);
    return sign * a.localeCompare(b, "en", { numeric: true });
  }

  function sort(header) {
    const sign = header.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    for (const other of header.parentNode.children) other.setAttribute("aria-sort", "none");
    header.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    for (const body of header.closest("table").tBodies) {
      const rows = [...body.rows].filter((row) => !row.matches(".group, .detail"));
      const value = (row) => row.cells[header.cellIndex].dataset.value;
      rows.sort((a, b) => compare(value(a), value(b), sign));
      for (const row of rows) body.append(...(row.detail ? [row, row.detail] : [row]));
    }
  }

  function element(kind, text, ...inside) {
    const made = document.createElement(kind);
    if (text !== null) made.textContent = text;
    made.append(...inside);
    return made;
  }

  function list(pairs) {
    const shown = Object.entries(pairs).filter(([, value]) => value !== null && value !== undefined);
    return element("dl", null, ...shown.map(([name, value]) =>
      element("div", null, element("dt", name), element("dd", typeof value === "object" ? JSON.stringify(value) : String(value)))));
  }

  function part(title, ...inside) {
    return element("section", null, element("h4", title), ...inside);
  }

  function describe(run) {
    const { commit, versions, machine } = details.places[run.place];
    const scores = Object.fromEntries(details.scores.map((name, k) => [name, run.scores[k]]));
    const { spec, place, counts, notes, scores: _, ...about } = run;
    const parts = [
      part("Run", list(about)),
      part("Spec", element("pre", JSON.stringify({ seed: run.seed, ...details.specs[spec] }, null, 2))),
      part("Scores", list(scores)),
      part("Counts", list(counts)),
      part("Made by", list({ commit, ...machine, ...versions })),
    ];
    const sentences = Array.isArray(notes) ? notes : Object.values(notes);
    if (sentences.length) parts.splice(2, 0, part("Notes", element("ul", null, ...sentences.map((note) => element("li", note.kind === "about" ? note.text : `${note.kind}: ${note.text}`)))));
    return parts;
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
    const cell = element("td", null, element("div", null, ...describe(details.runs[Number(row.dataset.run)])));
    cell.colSpan = row.cells.length;
    row.detail = element("tr", null, cell);
    row.detail.className = "detail";
    row.after(row.detail);
  }

  function filter(words) {
    const wanted = words.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    const rows = document.querySelectorAll("tr[data-run]");
    for (const row of rows) {
      const group = row.parentNode.rows[0].textContent;
      const says = `${group} ${row.textContent}`.toLowerCase();
      row.hidden = !wanted.every((word) => says.includes(word));
      if (row.detail) row.detail.hidden = row.hidden;
      shown += !row.hidden;
    }
    for (const body of document.querySelectorAll("table.runs tbody")) {
      body.hidden = ![...body.rows].some((row) => row.dataset.run !== undefined && !row.hidden);
    }
    document.getElementById("filtered").textContent = wanted.length ? `${shown} of ${rows.length}` : "";
  }

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (button?.matches("table.sortable thead button")) sort(button.closest("th"));
    if (button?.matches(".opens")) toggle(button);
  });
  document.getElementById("filter").addEventListener("input", (event) => filter(event.target.value));
})();

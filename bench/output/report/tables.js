// Unpacking what the page holds compressed, and sorting of tables.
"use strict";
(() => {
  // the text of a script element, which holds it as the base64 of gzip
  window.unpack = (script) => {
    const packed = Uint8Array.from(atob(script.textContent), (letter) => letter.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };

  const { compare: alphabet } = new Intl.Collator("en", { numeric: true });

  // numbers by size, words by alphabet (numbers in them by size), what is absent last either way
  window.compare = (a, b, sign) => {
    if (a === undefined || b === undefined) return (a === undefined) - (b === undefined);
    const [x, y] = [Number(a), Number(b)];
    if (!Number.isNaN(x) && !Number.isNaN(y)) return sign * (x - y || 0);
    return sign * alphabet(a, b);
  };

  function sort(header) {
    const sign = header.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    for (const other of header.parentNode.children) other.setAttribute("aria-sort", "none");
    header.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    const table = header.closest("table");
    if (table.sortRows) {
      table.sortRows(header.cellIndex, sign);
      return;
    }
    for (const body of table.tBodies) {
      const rows = [...body.rows].filter((row) => !row.matches(".group"));
      const value = (row) => row.cells[header.cellIndex].dataset.value;
      rows.sort((a, b) => window.compare(value(a), value(b), sign));
      body.append(...rows);
    }
  }

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (button?.matches("table.sortable thead button")) sort(button.closest("th"));
  });
})();

"use strict";
// Tables that sort by a click on a heading (or by a menu where the headings are hidden), and a filter for what is off.
(() => {
  const collator = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });

  function value(row, column) {
    const cell = row.cells[column];
    if (!cell) return null;
    if (cell.dataset.value !== undefined) return cell.dataset.value === "" ? null : Number(cell.dataset.value);
    const text = cell.textContent.trim();
    return text === "" ? null : text;
  }

  function compare(a, b) {
    if (typeof a === "number" && typeof b === "number") return a - b;
    return collator.compare(String(a), String(b));
  }

  function prepare(table) {
    const body = table.tBodies[0];
    const original = [...body.rows];
    const heads = [...table.tHead.rows[0].cells];
    const menu = document.createElement("select");
    menu.add(new Option("as listed", ""));

    function sort(column, direction) {
      heads.forEach((head, k) => head.setAttribute("aria-sort", k === column && direction ? direction : "none"));
      if (!direction) {
        original.forEach((row) => { row.classList.remove("unlisted"); body.append(row); });
        menu.value = "";
        return;
      }
      const sign = direction === "ascending" ? 1 : -1;
      const rows = original.filter((row) => !row.classList.contains("group"));
      const keyed = rows.map((row) => [value(row, column), row]);
      // What has no value stands last, whichever way the rest is sorted.
      keyed.sort(([a], [b]) => (a === null || b === null ? (a === null) - (b === null) : sign * compare(a, b)));
      original.filter((row) => row.classList.contains("group")).forEach((row) => row.classList.add("unlisted"));
      keyed.forEach(([, row]) => body.append(row));
      menu.value = `${column}:${direction}`;
    }

    heads.forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.append(button);
      head.setAttribute("aria-sort", "none");
      button.addEventListener("click", () => {
        const next = { none: "ascending", ascending: "descending", descending: "" };
        sort(column, next[head.getAttribute("aria-sort")]);
      });
      const name = button.textContent.trim();
      menu.add(new Option(`${name}, rising`, `${column}:ascending`));
      menu.add(new Option(`${name}, falling`, `${column}:descending`));
    });
    menu.addEventListener("change", () => {
      const [column, direction] = menu.value.split(":");
      sort(Number(column), direction || "");
    });

    const bar = document.createElement("p");
    bar.className = "sortbar small";
    const sorter = document.createElement("label");
    sorter.className = "sorter";
    sorter.append("Sort: ", menu);
    bar.append(sorter);
    if (original.some((row) => row.dataset.off === "yes")) {
      const box = document.createElement("input");
      box.type = "checkbox";
      const filter = document.createElement("label");
      filter.append(box, " hide what agrees");
      box.addEventListener("change", () => table.classList.toggle("only-off", box.checked));
      bar.append(filter);
    }
    table.before(bar);
  }

  document.querySelectorAll("table.sortable").forEach(prepare);
})();

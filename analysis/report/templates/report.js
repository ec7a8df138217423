"use strict";
(() => {
  const root = document.documentElement;
  const store = {
    get(key) { try { return localStorage.getItem(key); } catch { return null; } },
    set(key, value) { try { localStorage.setItem(key, value); } catch { /* a page from a file may have no storage */ } },
  };

  const themes = ["system", "light", "dark"];
  const theme = document.getElementById("theme");
  const setTheme = (name) => {
    root.dataset.theme = name;
    theme.textContent = `Light or dark: ${name}`;
    store.set("acmr-theme", name);
  };
  const stored = store.get("acmr-theme");
  setTheme(themes.includes(stored) ? stored : "system");
  theme.addEventListener("click", () => setTheme(themes[(themes.indexOf(root.dataset.theme) + 1) % themes.length]));

  const colors = document.getElementById("colors");
  const setColors = (name) => {
    root.dataset.colors = name;
    colors.setAttribute("aria-pressed", String(name === "colorblind"));
    store.set("acmr-colors", name);
  };
  setColors(store.get("acmr-colors") === "colorblind" ? "colorblind" : "paper");
  colors.addEventListener("click", () => setColors(root.dataset.colors === "paper" ? "colorblind" : "paper"));

  const value = (cell) => cell.dataset.value ?? cell.textContent.trim();
  const compare = (a, b, numeric) => numeric ? Number(a) - Number(b) : a.localeCompare(b, "en", { numeric: true });
  const table = document.getElementById("run-table");
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = head.querySelector("button");
    if (!button) return;
    button.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      heads.forEach((other) => other.querySelector("button") && other.setAttribute("aria-sort", "none"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const body = table.tBodies[0];
      const numeric = head.classList.contains("number");
      const rows = [...body.rows].map((row) => ({ row, key: value(row.cells[column]) }));
      // What is not known stays at the end whichever way the table is sorted.
      rows.sort((a, b) => (a.key === "") - (b.key === "") || (up ? 1 : -1) * compare(a.key, b.key, numeric));
      body.append(...rows.map(({ row }) => row));
    });
  });
})();

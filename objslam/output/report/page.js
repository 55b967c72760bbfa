"use strict";
// A click on a column's head sorts the table by this column. A second click reverses the order. Empty cells stay at the end.
for (const head of document.querySelectorAll("table.sortable th")) {
  const sort = () => {
    const table = head.closest("table"), body = table.tBodies[0];
    const column = head.cellIndex, numeric = head.classList.contains("number");
    const down = head.getAttribute("aria-sort") === "ascending";
    const value = row => row.cells[column].dataset.value ?? row.cells[column].textContent.trim();
    const rows = [...body.rows].sort((a, b) => {
      const x = value(a), y = value(b);
      if (x === "" || y === "") return (x === "") - (y === "");
      const order = numeric ? Number(x) - Number(y) : x.localeCompare(y, undefined, {numeric: true});
      return down ? -order : order;
    });
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    body.append(...rows);
  };
  head.querySelector("button").addEventListener("click", sort);
}
// A table that is wider than the page says so, because nothing else shows that it goes on.
const tellWide = () => {
  for (const hint of document.querySelectorAll(".scroll-hint"))
    hint.classList.toggle("needed", hint.nextElementSibling.scrollWidth > hint.nextElementSibling.clientWidth + 1);
};
addEventListener("resize", tellWide);
tellWide();
// A printed page cannot be unfolded, so all details are open in print.
let folded = [];
addEventListener("beforeprint", () => {
  folded = [...document.querySelectorAll("details:not([open])")];
  for (const part of folded) part.open = true;
});
addEventListener("afterprint", () => { for (const part of folded) part.open = false; });

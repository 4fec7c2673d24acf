for (const button of document.querySelectorAll(".sort")) {
  button.addEventListener("click", () => {
    const head = button.closest("th"), table = head.closest("table"), column = head.cellIndex;
    const best = head.matches(".name") || button.dataset.lower ? "ascending" : "descending";
    const before = head.getAttribute("aria-sort");
    const order = before === best ? (best === "ascending" ? "descending" : "ascending") : best;
    for (const other of table.querySelectorAll("thead th")) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", order);
    const sign = order === "ascending" ? 1 : -1;
    // Claimed and published rows have bodies of their own, and stay below the verified ones.
    for (const body of table.tBodies) {
      const rows = [...body.rows].filter((row) => !row.matches(".kind"));
      const key = (row) => row.cells[column].dataset.value;
      rows.sort((a, b) => {
        if (head.matches(".name")) {
          return sign * a.cells[column].textContent.localeCompare(b.cells[column].textContent);
        }
        const [x, y] = [key(a), key(b)];
        if (x === undefined || y === undefined) return (x === undefined) - (y === undefined);
        return sign * (x - y);
      });
      body.append(...rows);
    }
  });
}

const compare = document.querySelector("#compare");
if (compare) {
  const get = (id) => document.getElementById(id);
  const pictures = JSON.parse(get("pictures").textContent);
  const show = () => {
    const period = Number(get("period").value);
    const shown = pictures.views[Number(get("view").value)][period];
    get("truth").src = shown.truth;
    get("prediction").src = shown.predictions[Number(get("method").value)];
    get("which").textContent = pictures.periods[period];
    get("period").setAttribute("aria-valuetext", pictures.periods[period]);
    get("name").textContent = shown.view;
  };
  for (const id of ["period", "view", "method"]) get(id).addEventListener("input", show);
  show();  // a browser that goes back keeps what was chosen
}

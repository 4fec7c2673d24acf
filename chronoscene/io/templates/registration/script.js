for (const figure of document.querySelectorAll(".flickers figure")) {
  const second = figure.querySelector("img.second");
  figure.querySelector("input[type=range]").addEventListener("input", (event) => {
    figure.querySelector(".blink").checked = false;
    second.style.opacity = event.target.value / 100;
  });
}
document.querySelector("#all")?.addEventListener("change", (event) => {
  for (const box of document.querySelectorAll(".blink")) box.checked = event.target.checked;
});

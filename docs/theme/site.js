// The viewer's frames are as tall as their pages, whose height depends on the lens and on the width.
for (const frame of document.querySelectorAll("iframe.viewer")) {
  const follow = () => {
    const page = frame.contentDocument; // null if the site is opened from files: then the heights of site.css hold
    if (page?.body && page.URL !== "about:blank")
      new ResizeObserver(() => (frame.style.height = `${page.body.offsetHeight + 2}px`)).observe(page.body);
  };
  frame.addEventListener("load", follow);
  follow(); // of a frame that has loaded already
}

// A table that is wider than the page becomes a list of its rows, whose cells name their columns: see site.css.
const tables = document.querySelectorAll(".md-typeset table:not([class])");
for (const table of tables) {
  const heads = [...table.querySelectorAll("th")].map((head) => head.textContent.trim());
  for (const row of table.tBodies[0].rows) [...row.cells].forEach((cell, i) => (cell.dataset.head = heads[i]));
}
const fit = () => {
  for (const table of tables) {
    table.removeAttribute("data-rows");
    table.toggleAttribute("data-rows", table.scrollWidth > table.closest("article").clientWidth);
  }
};
addEventListener("resize", fit);
addEventListener("toggle", fit, true); // of a folded table, which has no width before
fit();

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

// What both pages need of the document.

export function parts(root: ParentNode) {
  return <T extends HTMLElement = HTMLElement>(name: string): T => {
    const found = root.querySelector<T>(`[data-part="${name}"]`);
    if (!found) throw new Error(`the page has no part ${name}`);
    return found;
  };
}

export const preferDark = (): boolean => window.matchMedia("(prefers-color-scheme: dark)").matches;

/** Light or dark theme: the system's, unless the user chooses one. */

import { byId } from './dom';
import { type Store, THEMES, type Theme } from './state';

const WORDS: Record<Theme, string> = { auto: 'Colours: as the system', light: 'Colours: light', dark: 'Colours: dark' };
const SIGNS: Record<Theme, string> = {
  auto: '<circle cx="10" cy="10" r="6.5"/><path d="M10 3.5a6.5 6.5 0 0 1 0 13z" class="full"/>',
  light: '<circle cx="10" cy="10" r="3.4" class="full"/><path d="M10 1.8v2.4M10 15.8v2.4M1.8 10h2.4M15.8 10h2.4M4.2 4.2l1.7 1.7M14.1 14.1l1.7 1.7M4.2 15.8l1.7-1.7M14.1 5.9l1.7-1.7"/>',
  dark: '<path d="M15.5 12.2A6.4 6.4 0 0 1 7.8 4.5a6.4 6.4 0 1 0 7.7 7.7z" class="full"/>',
};

/** Keeps the page in its colours, and calls `paint` with the map's when they change. */
export function keepTheme(store: Store, paint: (ground: string) => void): void {
  const button = byId<HTMLButtonElement>('theme');
  const dark = matchMedia('(prefers-color-scheme: dark)');
  const show = () => {
    const { theme } = store.state;
    document.documentElement.dataset.theme = theme === 'auto' ? (dark.matches ? 'dark' : 'light') : theme;
    button.innerHTML = `<svg viewBox="0 0 20 20" width="20" height="20" aria-hidden="true">${SIGNS[theme]}</svg>`;
    button.setAttribute('aria-label', WORDS[theme]);
    button.title = WORDS[theme];
    paint(getComputedStyle(document.documentElement).getPropertyValue('--ground').trim());
  };
  button.addEventListener('click', () => {
    store.set({ theme: THEMES[(THEMES.indexOf(store.state.theme) + 1) % THEMES.length] ?? 'auto' });
  });
  dark.addEventListener('change', show);
  store.watch(({ theme }) => theme, show);
}

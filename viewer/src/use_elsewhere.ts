/** Lines of code for other maps and programs, with the current layer, style and sun. The service writes them. */

import { html } from './dom';
import type { PanelContext } from './panels';
import { pictureQuery } from './query';
import { copyButton } from './saved';
import { inWords, isAbort } from './service';

interface ClientLines {
  readonly client: string;
  readonly text: string;
}

const CALM_MS = 400;

/** Fills a part of a panel. Returns what ends its work. */
export function mountUseElsewhere(container: HTMLElement, { store, service, level }: PanelContext): () => void {
  const lists = html('div', { class: 'clients' });
  container.append(
    html('h2', {}, 'Use this map elsewhere'),
    html('p', { class: 'note' }, 'Lines with the layer and the sun of this page, to copy.'),
    lists,
  );
  let loading = new AbortController();
  let timer: number | undefined;
  const opened = new Set<string>();
  const show = (lines: readonly ClientLines[]) => {
    lists.replaceChildren(...lines.map(({ client, text }) => {
      const details = html('details', { open: opened.has(client) }, html('summary', {}, client),
        html('div', { class: 'copied' },
          html('pre', { class: 'lines', tabindex: 0, 'aria-label': `Lines for ${client}` }, text),
          copyButton(() => text, `the lines for ${client}`)));
      details.addEventListener('toggle', () => {
        if (details.open) opened.add(client);
        else opened.delete(client);
      });
      return details;
    }));
  };
  const end = store.watch((state) => [state.level, pictureQuery(state)] as const, ([, query]) => {
    clearTimeout(timer);
    timer = window.setTimeout(async () => {
      loading.abort();
      loading = new AbortController();
      try {
        show(await service.json<ClientLines[]>(service.of(level().name, 'lines.json', query), loading.signal, { early: true }));
      } catch (error) {
        if (!isAbort(error)) lists.replaceChildren(html('p', { class: 'fail' }, inWords(error)));
      }
    }, lists.hasChildNodes() ? CALM_MS : 0);
  });
  return () => {
    end();
    clearTimeout(timer);
    loading.abort();
  };
}

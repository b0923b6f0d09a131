/** The page's modules for Node: Vite reads their TypeScript. Nothing of a page is there: what needs one is tested in a browser. */

import { after } from 'node:test';
import { createServer } from 'vite';

const server = await createServer({ root: new URL('..', import.meta.url).pathname, server: { middlewareMode: true, ws: false }, appType: 'custom', logLevel: 'error', optimizeDeps: { noDiscovery: true } });
after(() => server.close());

export const load = (path) => server.ssrLoadModule(`/src/${path}`);

// Of the viewer's page: `make lint` runs it in the folder above, over data/*.js.
import tseslint from "typescript-eslint";

// What no-explicit-any is for annotations of TypeScript, for types of JSDoc.
const noAny = {
  create: ({ sourceCode, report }) => ({
    Program() {
      for (const comment of sourceCode.getAllComments())
        if (/^\*[^]*\{[^@]*\bany\b[^@]*\}/.test(comment.value))
          report({ loc: comment.loc, message: "`any` checks nothing: say `unknown`, or the type" });
    },
  }),
};

export default tseslint.config({
  files: ["data/*.js"],
  ignores: ["data/uplot.js"],
  extends: [tseslint.configs.strictTypeChecked],
  plugins: { page: { rules: { "no-any": noAny } } },
  languageOptions: { parserOptions: { projectService: true } },
  rules: {
    "page/no-any": "error",
    "one-var": ["error", "never"],
    "@typescript-eslint/restrict-template-expressions": ["error", { allowNumber: true }],
    "@typescript-eslint/no-confusing-void-expression": "off",
    "@typescript-eslint/no-unnecessary-condition": "off", // takes what others change meanwhile for what it was
    "@typescript-eslint/no-unnecessary-type-parameters": "off", // $("#low"), whose type follows from where it goes
  },
});
